"""Local page that pans and zooms a run of any size: its server, and its tiles.

The server answers on the loopback only, and only to pages that it has written itself. Tiles of a run's image at every
level: power in hundredths of dB, and blocks; it also tells what a pixel holds.
"""

from __future__ import annotations

import json
import math
import re
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.errors import InputError, ProcessingError
from blocksar.measurement.targets import Target
from blocksar.products.pictures.overview import level_of, overview, stretch
from blocksar.runs.finished import FinishedRun

SIDE = 256  # cells along a side of a tile
NOTHING = -32768  # a cell that is not covered
DARKEST = -300.0  # dB
KEPT = 400  # tiles in memory, of 128 KiB
LAYERS = ("height", "incidence_angle", "visibility", "noise_equivalent")  # that a pixel may have


@dataclass(frozen=True, eq=False)
class ViewerTiles:
    """Tiles of an image; level k has cells of 2^k pixels, as the pyramid of a run (`stores.pyramid`).

    Levels that the run has no pyramid for are reduced from the pixels, strip by strip.
    """

    source: FinishedRun

    @cached_property
    def shapes(self) -> list[tuple[int, int]]:
        """Shape of each level, from that of the image down to one that fits a tile."""
        shape = self.source.y.size, self.source.x.size
        shapes = [shape]
        while max(shape) > SIDE:
            shape = -(-shape[0] // 2), -(-shape[1] // 2)
            shapes.append(shape)
        return shapes

    @cached_property
    def stored(self) -> int:
        """Number of levels in the run's pyramid."""
        return stores.levels_of(self.source.image)

    def window(self, level: int, row: int, column: int) -> tuple[slice, slice]:
        """Cells of a tile, as rows and columns of its level.

        Raises
        ------
        InputError
            If there is no such tile.
        """
        if 0 <= level < len(self.shapes):
            n_y, n_x = self.shapes[level]
            if 0 <= row * SIDE < n_y and 0 <= column * SIDE < n_x:
                y, x = row * SIDE, column * SIDE
                return slice(y, min(y + SIDE, n_y)), slice(x, min(x + SIDE, n_x))
        raise InputError(f"there is no tile {level}/{row}/{column}; the page asks for others")

    def power(self, level: int, row: int, column: int) -> NDArray[np.int16]:
        """Mean power of a tile's cells (n_y, n_x) in hundredths of dB, from low y to high; NOTHING if not covered."""
        window = self.window(level, row, column)
        if 1 <= level <= self.stored:
            power = stores.read_region(self.source.image, stores.level_name(level), window)
        else:
            power = self._reduced(level, window)
        with np.errstate(divide="ignore", invalid="ignore"):
            decibel = np.clip(10 * np.log10(power.astype(np.float64)), DARKEST, -DARKEST)
        return np.where(np.isfinite(power), np.rint(100 * np.nan_to_num(decibel)), NOTHING).astype(np.int16)

    def _reduced(self, level: int, window: tuple[slice, slice]) -> NDArray[Any]:
        """Average the power of covered pixels over cells that the pyramid does not have."""
        base = min(level, self.stored)
        side = 2 ** (level - base)
        shape = self.shapes[base]
        rows, columns = (slice(part.start * side, min(part.stop * side, n))
                         for part, n in zip(window, shape, strict=True))  # fmt: skip

        whole = level_of(self.source, base)[0] if base else self.source.read

        def read(some: slice, others: slice) -> NDArray[Any]:
            return whole(slice(rows.start + some.start, rows.start + some.stop), columns)

        x, y = (np.arange(part.stop - part.start, dtype=np.float64) for part in (columns, rows))
        return overview(read, x, y, max_pixels=SIDE, looks="mean", cell=(side, side)).power

    def blocks(self, level: int, row: int, column: int) -> NDArray[np.int16]:
        """Block of the first pixel of each of a tile's cells (n_y, n_x); -1 where not covered."""
        side = 2**level
        rows, columns = self.window(level, row, column)
        parts = [
            self.source.read_block(
                slice(first * side, (min(first + 16, rows.stop) - 1) * side + 1, side),
                slice(columns.start * side, (columns.stop - 1) * side + 1, side),
            )
            for first in range(rows.start, rows.stop, 16)
        ]
        return np.concatenate(parts).astype(np.int16)

    def pixel(self, row: int, column: int) -> dict[str, Any]:
        """Describe a pixel.

        Raises
        ------
        InputError
            If there is none.
        """
        source = self.source
        if not source.inside(row, column):
            raise InputError(f"there is no pixel {row}, {column}; the page asks for others")
        at = slice(row, row + 1), slice(column, column + 1)
        value, x, y = complex(source.read(*at)[0, 0]), float(source.x[column]), float(source.y[row])
        found: dict[str, Any] = {"x": x, "y": y, "row": row, "column": column}
        if math.isfinite(value.real):
            power = abs(value) ** 2
            found["db"] = round(10 * math.log10(power), 2) if power > 0 else DARKEST
            found["phase"] = round(math.atan2(value.imag, value.real), 4)
            found["block"] = int(source.read_block(*at)[0, 0])
            for name in LAYERS:
                if (source.image / name / "zarr.json").exists():
                    layer = float(source.read_layer(name, *at)[0, 0])
                    found[name] = layer if math.isfinite(layer) else None
        return found | self._geodetic(x, y, found.get("height"))

    def _geodetic(self, x: float, y: float, height: float | None) -> dict[str, float]:
        if self.source.georeference is None:
            return {}
        z = self.source.ground_height if height is None else height
        try:
            latitude, longitude, _ = self.source.georeference.to_geodetic(np.array([x, y, z]))
        except InputError:  # pyproj is not installed
            return {}
        return {"latitude": round(float(latitude), 7), "longitude": round(float(longitude), 7)}

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Range in dB for the image, from its coarsest level."""
        top = self.power(len(self.shapes) - 1, 0, 0)
        low, high = stretch(np.where(top == NOTHING, np.nan, top / 100))
        return math.floor(low), math.ceil(high)

    @cached_property
    def kept(self) -> Any:
        """Make a function with a cache that returns the bytes of a tile by kind, level, row and column."""

        @lru_cache(maxsize=KEPT)
        def tile(kind: str, level: int, row: int, column: int) -> bytes:
            read = self.power if kind == "power" else self.blocks
            return read(level, row, column).astype("<i2").tobytes()

        return tile


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


def directions(source: FinishedRun) -> list[dict[str, Any]]:
    """Directions in the image as x, y of any length: north, or else the x and y axes, and the look direction.

    The look is that at the middle of the image and of its dwell.
    """
    x, y = float(source.x.mean()), float(source.y.mean())
    geometry = source.geometry_at(x, y)
    first, last = (float(edge) for edge in geometry.beam.dwell(np.array(x), np.array(y)))
    time = (first + last) / 2 if first < last else geometry.epoch
    away = np.array([x, y]) - geometry.track.position(np.array(time))[:2]
    found = [{"label": "x", "x": 1.0, "y": 0.0}, {"label": "y", "x": 0.0, "y": 1.0}]
    if source.georeference is not None:
        turn = math.radians(source.georeference.rotation)
        found = [{"label": "N", "x": math.sin(turn), "y": math.cos(turn)}]
    return [*found, {"label": "look", "x": float(away[0]), "y": float(away[1])}] if away.any() else found


def page_of(tiles: ViewerTiles, targets: Sequence[Target]) -> bytes:
    """Page as one HTML file, which requests tiles from this server and nothing else."""
    source = tiles.source
    dx, dy = source.spacing
    low, high = tiles.limits
    facts = {
        "title": source.title, "run": str(source.folder), "shapes": tiles.shapes, "side": SIDE, "nothing": NOTHING,
        "x": float(source.x[0]), "y": float(source.y[0]), "dx": dx, "dy": dy, "low": low, "high": high,
        "stored": tiles.stored, "arrows": directions(source),
        "targets": [{"name": each.name, "x": each.x, "y": each.y} for each in targets],
    }  # fmt: skip
    # Escape the text of a run, so that it can neither end the script nor begin a comment in it.
    text = json.dumps(facts).replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    template = (resources.files("blocksar.products") / "view.html").read_text(encoding="utf-8")
    return template.replace("/*FACTS*/null", text).encode()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, tiles: ViewerTiles, page: bytes, *arguments: Any) -> None:
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
        """Tell whether a request names this server's own address, not another name that resolves to it."""
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
        """Suppress the log of requests."""


class Viewer:
    """A server that shows a run until it is closed.

    Attributes
    ----------
    url : str
        Where the page is.
    """

    def __init__(self, tiles: ViewerTiles, targets: Sequence[Target], port: int) -> None:
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
