# graphvio as a command, with its kernels compiled; the folder with the recordings is mounted at /data:
#     docker build -t graphvio .
#     docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/data" graphvio run RECORDING
# Any user may run it: matplotlib's settings are where all can write. scripts/check_image builds it and runs the main job.
FROM python:3.12-slim

RUN useradd --create-home graphvio && install --directory --owner graphvio /var/cache/graphvio /data
COPY pyproject.toml README.md LICENSE /source/
COPY graphvio /source/graphvio
COPY configs /source/configs
RUN pip install --no-cache-dir '/source[sessions]' && rm -r /source

USER graphvio
ENV GRAPHVIO_CACHE_DIR=/var/cache/graphvio
RUN graphvio warmup
ENV MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /data
ENTRYPOINT ["graphvio"]
CMD ["--help"]
