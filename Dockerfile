# graphvio as a command, with its kernels compiled:  docker build -t graphvio . && docker run --rm graphvio doctor
# Recordings are mounted:  docker run --rm -v "$PWD:/data" graphvio run /data/RECORDING --out /data/results
FROM python:3.12-slim

RUN useradd --create-home graphvio
COPY pyproject.toml README.md LICENSE /source/
COPY graphvio /source/graphvio
COPY configs /source/configs
RUN pip install --no-cache-dir '/source[sessions]' && rm -r /source

USER graphvio
WORKDIR /home/graphvio
RUN graphvio warmup
ENTRYPOINT ["graphvio"]
CMD ["--help"]
