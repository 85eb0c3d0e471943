"""HTTP server for the health of a live run: Prometheus metrics at ``/metrics``, state of the stages at ``/healthz``."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from http import HTTPStatus
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from graphvio.errors import ServiceError, importing
from graphvio.live.figures import STALE
from graphvio.measurements.estimate import Status

Figures = Mapping[str, float | int | str | None]

_TOTALS = ("images", "imu_samples", "framesets", "estimates", "imu_lost")
_TOTAL_PREFIXES = (
    "skipped",
    "event",
    "status_",
    "recorded",
    "framesets_not",
    "images_not",
    "messages_not",
    "results_not",
)


class HealthServer:
    """HTTP server for metrics and health, which runs in threads of its own.

    Args:
        status: returns the figures by name; ``health`` is ``ok`` if all stages run.
        host: address to listen on; the default cannot be reached from other machines.
        port: port to listen on; 0 takes a free one.

    Attributes:
        address: ``HOST:PORT`` that it listens on.

    Raises:
        ServiceError: if the address cannot be used.
        MissingExtraError: if the extra ``live`` is not installed.
    """

    def __init__(self, status: Callable[[], Figures], host: str = "127.0.0.1", port: int = 0) -> None:
        with importing("prometheus-client", "live", "metrics of a live run"):
            from prometheus_client import CollectorRegistry, make_wsgi_app
        registry = CollectorRegistry(auto_describe=False)
        registry.register(_Collector(status))
        self._status = status
        self._metrics = make_wsgi_app(registry)
        try:
            self._server = make_server(host, port, self._answer, _ThreadingServer, _QuietHandler)
        except OSError as error:
            raise ServiceError(
                f"{host}:{port}: cannot be listened on ({error.strerror}); choose another port"
            ) from None
        self.address = f"{host}:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="graphvio-health", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _answer(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        path = environ.get("PATH_INFO", "")
        if path == "/metrics":
            return list(self._metrics(environ, start_response))
        if path == "/healthz":
            status = self._status()
            good = status.get("health") == "ok"
            return _reply(start_response, HTTPStatus.OK if good else HTTPStatus.SERVICE_UNAVAILABLE, status)
        return _reply(start_response, HTTPStatus.NOT_FOUND, {"there is": "/metrics and /healthz"})


def _reply(start_response: Callable[..., Any], status: HTTPStatus, content: Mapping[str, Any]) -> list[bytes]:
    start_response(f"{status.value} {status.phrase}", [("Content-Type", "application/json; charset=utf-8")])
    return [json.dumps(content, indent=1).encode() + b"\n"]


class _Collector:
    """Collector of the figures as Prometheus metrics; of the texts, only the status is included."""

    def __init__(self, status: Callable[[], Figures]) -> None:
        self._status = status

    def collect(self) -> Iterator[Any]:
        """Yield all metrics."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        figures = self._status()
        for name, value in figures.items():
            if isinstance(value, int | float):
                is_total = name in _TOTALS or name.startswith(_TOTAL_PREFIXES)
                kind = CounterMetricFamily if is_total else GaugeMetricFamily
                yield kind(f"graphvio_{name}", f"{name} of the odometry", value=float(value))
        status = GaugeMetricFamily("graphvio_status", "1 for the newest estimate's status", labels=["status"])
        for each in (*map(str, Status), STALE):
            status.add_metric([each], float(figures.get("status") == each))
        yield status
        yield GaugeMetricFamily("graphvio_up", "1 while all stages run", value=float(figures.get("health") == "ok"))


class _ThreadingServer(ThreadingMixIn, WSGIServer):
    """Server with a thread per connection, so that an idle client holds up neither others nor `close`."""

    daemon_threads = True
    block_on_close = False


class _QuietHandler(WSGIRequestHandler):
    """Handler that writes no log and waits for a request for at most ten seconds."""

    timeout = 10.0

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
