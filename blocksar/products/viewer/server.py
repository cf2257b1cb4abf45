"""The server of the viewer: loopback only, and only for pages that it has written itself."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Sequence
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

from blocksar.errors import InputError, ProcessingError
from blocksar.measurement.targets import Target
from blocksar.products.viewer.tiles import NOTHING, SIDE, Tiles

HOST = "127.0.0.1"
TILE = re.compile(r"/(power|blocks)/(\d{1,2})/(\d{1,6})/(\d{1,6})")
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def page_of(tiles: Tiles, targets: Sequence[Target]) -> bytes:
    """The page: one HTML file, which asks this server for tiles and for nothing else."""
    source = tiles.source
    dx, dy = source.spacing
    low, high = tiles.limits
    facts = {
        "title": source.title, "run": str(source.folder), "shapes": tiles.shapes, "side": SIDE, "nothing": NOTHING,
        "x": float(source.x[0]), "y": float(source.y[0]), "dx": dx, "dy": dy, "low": low, "high": high,
        "stored": tiles.stored,
        "targets": [{"name": each.name, "x": each.x, "y": each.y} for each in targets],
    }  # fmt: skip
    # No text of a run may end the script or begin a comment in it.
    text = json.dumps(facts).replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    template = (resources.files("blocksar.products.viewer") / "view.html").read_text(encoding="utf-8")
    return template.replace("/*FACTS*/null", text).encode()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, tiles: Tiles, page: bytes, *arguments: Any) -> None:
        self._tiles, self._page = tiles, page
        super().__init__(*arguments)

    def do_GET(self) -> None:
        if not self._is_own():
            self._answer(403, "text/plain", b"this page is served to this machine only")
            return
        try:
            kind, content = self._content()
        except InputError as error:
            self._answer(404, "text/plain; charset=utf-8", str(error).encode())
        except (ProcessingError, OSError) as error:
            self._answer(500, "text/plain; charset=utf-8", str(error).encode())
        else:
            self._answer(200, kind, content)

    def _is_own(self) -> bool:
        """Whether it was asked for by its own address: another name that leads here is another site's."""
        port = self.connection.getsockname()[1]
        own = {f"{HOST}:{port}", f"localhost:{port}"}
        origin = self.headers.get("Origin")
        return self.headers.get("Host") in own and (origin is None or origin.removeprefix("http://") in own)

    def _content(self) -> tuple[str, bytes]:
        asked = urlsplit(self.path)
        if asked.path == "/":
            return "text/html; charset=utf-8", self._page
        if (tile := TILE.fullmatch(asked.path)) is not None:
            kind, level, row, column = tile.groups()
            return "application/octet-stream", self._tiles.kept(kind, int(level), int(row), int(column))
        if asked.path == "/pixel":
            given = parse_qs(asked.query)
            try:
                row, column = (int(given[name][0]) for name in ("row", "column"))
            except (KeyError, ValueError):
                raise InputError("a pixel is asked for by its row and column") from None
            return "application/json", json.dumps(self._tiles.pixel(row, column)).encode()
        raise InputError(f"there is nothing at {asked.path[:80]!r}")

    def _answer(self, status: int, kind: str, content: bytes) -> None:
        try:
            self.send_response(status)
            for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **HEADERS}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)
        except (BrokenPipeError, ConnectionResetError):  # the page was closed, or has moved on
            self.close_connection = True

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing of requests."""


class Viewer:
    """A server that shows a run until it is closed.

    Attributes
    ----------
    url : str
        Where the page is.
    """

    def __init__(self, tiles: Tiles, targets: Sequence[Target], port: int) -> None:
        handler = partial(_Handler, tiles, page_of(tiles, targets))
        try:
            self._server = ThreadingHTTPServer((HOST, port), handler)
        except OSError as error:
            raise InputError(f"port {port} cannot be used ({error.strerror}); give another, or leave it out") from error
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Serve until the viewer is closed, or the process is interrupted."""
        while self._thread.is_alive():
            self._thread.join(0.5)

    def serve(self) -> None:
        """Serve until the process is interrupted, and close."""
        with self:
            self.wait()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Viewer: {self.url}>"
