"""A real S3 server on loopback for tests: moto's, in a process of its own that ends with the tests.

Around moto: a log of requests, requests to fail on demand, and buckets called private-*, which refuse unsigned requests
(moto itself asks for nothing).
"""

import json
import os
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from pyarrow import fs

REGION = "us-east-1"
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret"}


@dataclass(frozen=True)
class S3Server:
    port: int

    @property
    def options(self) -> str:
        return f"?endpoint_override=127.0.0.1:{self.port}&region={REGION}&scheme=http"

    def location(self, path: str) -> str:
        return f"s3://{path}{self.options}"

    def filesystem(self) -> fs.S3FileSystem:
        return fs.S3FileSystem(
            access_key="key",
            secret_key="secret",  # noqa: S106 - of a server that knows none
            endpoint_override=f"127.0.0.1:{self.port}",
            scheme="http",
            region=REGION,
            allow_bucket_creation=True,
        )

    def upload(self, folder: Path, target: str) -> None:
        """Copy a local tree into bucket/prefix."""
        store = self.filesystem()
        store.create_dir(target.partition("/")[0])
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            self.put(f"{target}/{file.relative_to(folder).as_posix()}", file.read_bytes())

    def put(self, key: str, content: bytes) -> None:
        with self.filesystem().open_output_stream(key) as stream:
            stream.write(content)

    def delete(self, key: str) -> None:
        self.filesystem().delete_file(key)

    def requests(self) -> list[dict[str, str]]:
        """Return the requests since it was last asked: method, path, query, range, is_signed."""
        return json.loads(self._ask("/_control/log"))

    def fail(self, count: int) -> None:
        """Answer the next requests with 503."""
        self._ask(f"/_control/fail/{count}")

    def delete_after(self, count: int, key: str) -> None:
        """Delete an object when that many requests of bytes were answered."""
        self._ask(f"/_control/delete/{count}/{key}")

    def _ask(self, path: str) -> bytes:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}", timeout=10) as answer:
            return bytes(answer.read())


@contextmanager
def s3_server() -> Iterator[S3Server]:
    """Start a server on a free port; end it at the end."""
    for package in ("moto", "flask", "flask_cors"):
        pytest.importorskip(package, reason=f"{package} is not installed (pip install '.[dev]'): no S3 server to ask")
    command = [sys.executable, "-W", "ignore", str(Path(__file__).resolve())]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            assert process.stdout is not None
            port = process.stdout.readline().strip()
            assert port, "the S3 server did not start"
            yield S3Server(int(port))
        finally:
            process.kill()


def free_port() -> int:
    """Return a port on which nobody listens."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class _Application:
    """WSGI: the controls of `S3Server` before moto."""

    def __init__(self, moto) -> None:
        self._moto = moto
        self._lock = threading.Lock()
        self._log: list[dict[str, str]] = []
        self._num_to_fail = 0
        self._num_reads_left = -1
        self._to_delete = ""

    def __call__(self, environ, start_response) -> list[bytes]:
        with self._lock:
            path = environ["PATH_INFO"]
            if path.startswith("/_control/"):
                return _answer(start_response, "200 OK", self._control(*path.split("/")[2:]))
            return self._refused(environ, start_response) or self._moto(environ, start_response)

    def _control(self, command: str, *args: str) -> bytes:
        if command == "fail":
            self._num_to_fail = int(args[0])
        elif command == "delete":
            self._num_reads_left, self._to_delete = int(args[0]), "/".join(args[1:])
        log = json.dumps(self._log).encode()
        self._log.clear()
        return log

    def _refused(self, environ, start_response):
        path, is_signed = environ["PATH_INFO"], "HTTP_AUTHORIZATION" in environ
        entry = {"method": environ["REQUEST_METHOD"], "path": path, "query": environ["QUERY_STRING"]}
        self._log.append({**entry, "range": environ.get("HTTP_RANGE", ""), "is_signed": str(is_signed)})
        if self._num_to_fail:
            self._num_to_fail -= 1
            return _answer(start_response, "503 Slow Down", _error("SlowDown"))
        if path.startswith("/private-") and not is_signed:
            return _answer(start_response, "403 Forbidden", _error("AccessDenied"))
        if "HTTP_RANGE" in environ:
            if self._num_reads_left == 0:
                self._delete()
            self._num_reads_left -= 1
        return None

    def _delete(self) -> None:
        from moto.s3.models import s3_backends  # noqa: PLC0415 - only in the server's process

        bucket, _, key = self._to_delete.partition("/")
        s3_backends["123456789012"]["aws"].delete_object(bucket, key)


def _answer(start_response, status: str, body: bytes) -> list[bytes]:
    start_response(status, [("Content-Type", "application/xml"), ("Content-Length", str(len(body)))])
    return [body]


def _error(code: str) -> bytes:
    return f"<?xml version='1.0'?><Error><Code>{code}</Code><Message>{code}</Message></Error>".encode()


def _serve() -> None:
    os.environ.update(KEYS)
    from moto.server import DomainDispatcherApplication, create_backend_app  # noqa: PLC0415 - only in its own process
    from werkzeug.serving import make_server  # noqa: PLC0415 - as above

    moto = DomainDispatcherApplication(create_backend_app)
    server = make_server("127.0.0.1", 0, _Application(moto), threaded=True)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    print(server.port, flush=True)  # noqa: T201 - for the process that started this one
    sys.stdin.buffer.read()  # until that process ends


if __name__ == "__main__":
    _serve()
