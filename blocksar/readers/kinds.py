"""Kinds of files and folders given as phase histories, recognised by their first bytes.

A table: the name of a kind, the mark that tells it, and what leads from there to a phase history. What is no data at
all comes first (`NOTHING`), then what readers and scenes are, then `OTHERS`; the first row whose mark fits counts
(`readers.found_at`). Marks are those of the formats' own definitions; where one has none (MATLAB 4, text), the whole
beginning has to look like it.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

START = 1 << 15  # bytes that are looked at


@dataclass(frozen=True)
class Start:
    """Start of a file: its name, its first bytes, and whether these are all."""

    name: str
    data: bytes
    whole: bool

    @property
    def text(self) -> str:
        """The first bytes as text, without a byte-order mark and white space before; characters that fit one byte."""
        encoding = "utf-16" if self.data[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1"
        return self.data.removeprefix(b"\xef\xbb\xbf").decode(encoding, "replace").lstrip()


Mark = Callable[[Start], bool]


class Kind(NamedTuple):
    """A kind of file: its name, its mark, and the remedy for users who give it.

    Attributes
    ----------
    name : str
        With its article; it may ask for `{detail}`, which `detail` finds in the beginning.
    mark : callable (start)
        Whether a file is of the kind.
    remedy : str
        What leads to a phase history. It may ask for `{path}`, for `{plain}`, the path of the file when it is
        unpacked, and for `{store}`, a name for the phase history.
    beside : bool
        Whether such files lie beside the data in a folder, and do not tell what that is.
    """

    name: str
    mark: Mark
    remedy: str
    detail: Callable[[Start], str] = lambda start: ""
    beside: bool = False


def begins(*marks: bytes, at: int = 0) -> Mark:
    """Make the mark of files with one of these byte strings at an offset."""
    return lambda start: start.data[at:].startswith(marks)


def matches(pattern: bytes) -> Mark:
    """Make the mark of files whose first bytes match a pattern."""
    return lambda start: re.match(pattern, start.data, re.DOTALL) is not None


def reads(pattern: str) -> Mark:
    """Make the mark of files whose beginning, as text, matches a pattern in any case."""
    return lambda start: re.match(pattern, start.text, re.IGNORECASE) is not None


def _nitf(of: bytes) -> Mark:
    """Make the mark of NITF files with a word in their leading headers."""
    return lambda start: start.data.startswith((b"NITF", b"NSIF")) and of in start.data


def _word(pattern: str) -> Callable[[Start], str]:
    """Make a function that finds the first group of a pattern in the beginning, for a message; empty if absent."""

    def found(start: Start) -> str:
        match = re.search(pattern, start.text, re.IGNORECASE | re.DOTALL)
        words = "" if match is None else " ".join(match[1].split())[:60]
        return f" ({words})" if words else ""

    return found


def _tar(start: Start) -> bool:
    return start.data[257:262] == b"ustar"


def _gzip_of_tar(start: Start) -> bool:
    if not start.data.startswith(b"\x1f\x8b"):
        return False
    with suppress(zlib.error):
        return _tar(Start("", zlib.decompressobj(31).decompress(start.data, START), whole=False))
    return False


def _member(suffix: bytes) -> Mark:
    """Make the mark of zip archives by the name of their first member."""

    def fits(start: Start) -> bool:
        if not start.data.startswith(b"PK\x03\x04") or len(start.data) < 30:
            return False
        name = start.data[30 : 30 + int(struct.unpack_from("<H", start.data, 26)[0])]
        return suffix in name

    return fits


def hdf5(start: Start) -> bool:
    return any(start.data[at:].startswith(b"\x89HDF\r\n\x1a\n") for at in (0, 512, 1024, 2048))


def _matlab4(start: Start) -> bool:
    """Recognise MATLAB 4: five integers (type, rows, columns, imaginary, name's length), a name and a zero byte."""
    if len(start.data) < 20:
        return False
    kind, rows, columns, imaginary, length = struct.unpack_from("<5i", start.data)
    name = start.data[20 : 20 + max(length, 0)]
    return (
        kind in (0, 10, 20, 30, 40, 50, 1, 11, 21, 31, 41, 51) and min(rows, columns) >= 0 and imaginary in (0, 1)
        and 1 < length < 64 and re.fullmatch(rb"[A-Za-z]\w*\0", name) is not None
    )  # fmt: skip


def ceos(start: Start, of: bytes = b"") -> bool:
    """Recognise CEOS: record 1 is a file descriptor; `of` are the first two codes of the next record."""
    if re.match(rb"\x00\x00\x00\x01[\xc0\x3f\x32\x0b]\xc0\x12\x12", start.data[:8]) is None:
        return False
    length = int(struct.unpack_from(">I", start.data, 8)[0]) if len(start.data) >= 12 else 0
    return start.data[length + 4 :].startswith(of)


def _text(start: Start) -> bool:
    with suppress(UnicodeDecodeError):
        text = start.data[: None if start.whole else -4].decode("utf-8", "strict")
        return bool(text.strip()) and all(c.isprintable() or c in "\t\r\n\f" for c in text)
    return False


def _table(start: Start) -> bool:
    """Recognise a table: lines of text with the same number of fields."""
    lines = [line for line in start.text.splitlines()[:6] if line.strip()]
    fields = {len(re.split(r"[,;\t]", line)) for line in (lines if start.whole else lines[:-1])}
    return _text(start) and len(fields) == 1 and fields.pop() > 1


AGAIN = "get it again"
ARRAYS = "build the phase history from its arrays with blocksar.collection"
ECHOES = "build the phase history from its echoes with blocksar.collection"
IMAGE = "give the CPHD file or the raw echoes that it was made from, since no image can be turned back into these"
LINK = "log in, or ask for a link that is still valid"
DESCRIBED = "give the data that it describes"

NOTHING: tuple[Kind, ...] = (
    # What is no file of data at all.
    Kind("an empty file", lambda s: not s.data, "get it again", beside=True),
    Kind("a file that begins with zeros only, as after an interrupted download", lambda s: not s.data.strip(b"\0"),
         "get it again"),
    Kind("a Git LFS pointer, which only names the file", begins(b"version https://git-lfs"),
         "fetch the file itself, in its repository: git lfs pull"),
    Kind("a web page{detail}, not the file that was asked for", reads("<!doctype html|<html"),
         f"{LINK}, and get it again", _word("<title>(.*?)</title>"), beside=True),
    Kind("an error message of a server{detail}, not the file that was asked for",
         reads(r"(<\?xml[^>]*>\s*)?<(Error|ExceptionReport|ServiceException)\b"), f"{LINK}, and get it again",
         _word("<(?:Code|Message)>(.*?)<")),
)  # fmt: skip
SCENE = Kind("a scene, not a phase history", lambda s: s.name.lower().endswith(".toml"),
             "write one first: `blocksar simulate {path} --out {store}`", beside=True)  # fmt: skip
OTHERS: tuple[Kind, ...] = (
    # Phase histories, echoes and images in the formats of others.
    Kind("a CPHD file of an old version{detail}, laid out in another way", begins(b"CPHD/0."),
         f"read it with sarpy (sarpy.io.phase_history), and {ARRAYS}", _word(r"CPHD/(\S+)")),
    Kind("a CPHD file of a version{detail} that is not known", begins(b"CPHD/"), "have it written as CPHD 1.1.0",
         _word(r"CPHD/(\S+)")),
    Kind("a SIDD file (NITF), an image", _nitf(b"SIDD"), IMAGE),
    Kind("a SICD file (NITF), an image", _nitf(b"SICD"), IMAGE),
    Kind("a NITF file, an image", _nitf(b""), IMAGE),
    Kind("a MATLAB 7.3 file (HDF5)", begins(b"MATLAB 7.3"), f"read it with h5py, and {ARRAYS}"),
    Kind("a netCDF 4 file (HDF5)", lambda s: hdf5(s) and (s.name.endswith(".nc") or b"_NCProperties" in s.data),
         f"read it with xarray.open_dataset, and {ARRAYS}"),
    Kind("an HDF5 file (as those of ICEYE and COSMO-SkyMed)", hdf5, f"read it with h5py, and {ECHOES}"),
    Kind("a netCDF 3 file", begins(b"CDF\1", b"CDF\2", b"CDF\5"), f"read it with xarray.open_dataset, and {ARRAYS}"),
    Kind("an HDF4 file", begins(b"\x0e\x03\x13\x01"), f"read it with pyhdf, and {ARRAYS}"),
    Kind("a MATLAB 4 file", _matlab4, f"read it with scipy.io.loadmat, and {ARRAYS}"),
    Kind("the manifest of a SAFE product", lambda s: s.text.startswith("<") and "XFDU" in s.text[:1000],
         "give the folder that it lies in", beside=True),
    Kind("an ENVISAT or ERS product of level 0", matches(rb'PRODUCT="[A-Z_]{8}0'), f"decode its packets, and {ECHOES}"),
    Kind("an ENVISAT or ERS product, an image", begins(b'PRODUCT="'), IMAGE),
    Kind("a CEOS file of an image", lambda s: ceos(s, b"\x32\x0b"), IMAGE),
    Kind("a CEOS file (volume, leader or trailer)", ceos, "give the file of the same product that has the data",
         beside=True),
    Kind("a COSAR file (TerraSAR-X), an image", begins(b"CSAR", at=28), IMAGE),
    Kind("a SIO file", begins(b"\xff\x01\x7f\xfe", b"\xfe\x7f\x01\xff"), f"read it with numpy.fromfile, and {ARRAYS}"),
    Kind("a GFF file (Sandia), an image", begins(b"GSATIMG"), IMAGE),
    # Archives, and files that are compressed.
    Kind("a file of several numpy arrays (npz)", _member(b".npy"), f"read it with numpy.load, and {ARRAYS}"),
    Kind("a SAFE product in a zip archive", _member(b".SAFE"), "unpack it first: unzip {path}"),
    Kind("a zarr store in a zip archive", _member(b"zarr.json"), "unpack it first: unzip {path} -d {store}"),
    Kind("a zip archive", begins(b"PK\3\4", b"PK\5\6", b"PK\7\x08"), "unpack it first: unzip {path}"),
    Kind("a tar archive", lambda s: _tar(s) or _gzip_of_tar(s), "unpack it first: tar -xf {path}"),
    Kind("a file compressed by gzip", begins(b"\x1f\x8b", b"\x1f\x9d"), "unpack it first: gzip -dc {path} > {plain}"),
    Kind("a file compressed by bzip2", matches(b"BZh[1-9]"), "unpack it first: bzip2 -dc {path} > {plain}"),
    Kind("a file compressed by xz", begins(b"\xfd7zXZ\0"), "unpack it first: xz -dc {path} > {plain}"),
    Kind("a file compressed by zstd", begins(b"\x28\xb5\x2f\xfd"), "unpack it first: zstd -dc {path} > {plain}"),
    Kind("a file compressed by lz4", begins(b"\x04\x22\x4d\x18"), "unpack it first: lz4 -dc {path} > {plain}"),
    Kind("a 7z archive", begins(b"7z\xbc\xaf\x27\x1c"), "unpack it first: 7z x {path}"),
    Kind("a RAR archive", begins(b"Rar!\x1a\x07"), "unpack it first: unrar x {path}"),
    # Arrays and tables.
    Kind("a numpy array (npy)", begins(b"\x93NUMPY"), f"read it with numpy.load, and {ARRAYS}"),
    Kind("a pickle of Python", matches(rb"\x80[\2-\5][^\0]"), f"read it with pickle.load, and {ARRAYS}"),
    Kind("a parquet file", begins(b"PAR1"), f"read it with pandas.read_parquet, and {ARRAYS}"),
    Kind("an Arrow file", begins(b"ARROW1"), f"read it with pandas.read_feather, and {ARRAYS}"),
    Kind("a SQLite database", begins(b"SQLite format 3\0"), f"read it with sqlite3, and {ARRAYS}"),
    # Pictures and documents.
    Kind("a TIFF file, an image", begins(b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), IMAGE),
    Kind("a PNG picture", begins(b"\x89PNG\r\n\x1a\n"), IMAGE, beside=True),
    Kind("a JPEG picture", begins(b"\xff\xd8\xff"), IMAGE, beside=True),
    Kind("a JPEG 2000 picture", begins(b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51"), IMAGE, beside=True),
    Kind("a GIF picture", begins(b"GIF8"), IMAGE, beside=True),
    Kind("a PDF document", begins(b"%PDF-"), DESCRIBED, beside=True),
    # Text.
    Kind("metadata of a zarr store", lambda s: s.name in ("zarr.json", ".zgroup", ".zarray", ".zattrs"),
         "give the folder that it lies in", beside=True),
    Kind("an XML file{detail}", lambda s: s.text.startswith("<") and _text(s), DESCRIBED,
         _word(r"<([A-Za-z][\w:.-]*)"), beside=True),
    Kind("a STAC item (JSON)", lambda s: s.text.startswith("{") and '"stac_version"' in s.text,
         "get the CPHD file that it links to, and give that", beside=True),
    Kind("a JSON file", lambda s: reads(r'[{\[]\s*["{\[\]}\d]')(s) and _text(s), DESCRIBED, beside=True),
    Kind("a table in text (CSV)", _table, f"read it with numpy.genfromtxt, and {ARRAYS}"),
    Kind("a text file", _text, DESCRIBED, beside=True),
    Kind("of no kind that blocksar knows{detail}", lambda s: True,
         f"if it holds samples, read them with numpy.fromfile, and {ARRAYS}",
         lambda s: f" (it begins with {s.data[:8]!r})", beside=True),
)  # fmt: skip
SAFE_IMAGES = Kind("a SAFE product, of images", lambda s: True, IMAGE)
