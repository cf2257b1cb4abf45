"""Files and folders of other kinds: each is told by its first bytes, in every command, with one remedy that works."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import os
import pickle
import shutil
import struct
import subprocess
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

import blocksar
from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.readers import registry as readers

CPHD = b"CPHD/1.1.0\nXML_BLOCK_SIZE := 1000\n\f\n" + bytes(range(256)) * 4
HDF5 = b"\x89HDF\r\n\x1a\n" + bytes(1000)


def written(write: Callable[[io.BytesIO], object]) -> bytes:
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def zipped(name: str, data: bytes = CPHD) -> bytes:
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:
        archive.writestr(name, data)
    return buffer.getvalue()


def tarred(mode: str) -> bytes:
    with tarfile.open(fileobj=(buffer := io.BytesIO()), mode=mode) as archive:  # type: ignore[call-overload]
        member = tarfile.TarInfo("collect.cphd")
        member.size = len(CPHD)
        archive.addfile(member, io.BytesIO(CPHD))
    return buffer.getvalue()


def ceos(first: bytes, second: bytes, length: int = 720) -> bytes:
    """Two records: number, four codes and length of each."""
    head = struct.pack(">I", 1) + first + struct.pack(">I", length)
    return head.ljust(length, b" ") + struct.pack(">I", 2) + second + bytes(100)


ROW = {"a": np.arange(3.0)}
# Name of the file, its bytes, and what is said of it.
FILES: dict[str, tuple[str, bytes, str]] = {
    "CPHD 0.3": ("x.cphd", b"CPHD/0.3\nXML_DATA_SIZE := 1000\n", "of an old version (0.3)"),
    "CPHD 1.2": ("x.cphd", b"CPHD/1.2.0\n", "version (1.2.0) that is not known; have it written as CPHD 1.1.0"),
    "SICD": (
        "x.nitf",
        b"NITF02.10".ljust(400) + b"IMSICD000",
        "is a SICD file (NITF), an image; give the CPHD file or the",
    ),
    "SIDD": ("x.ntf", b"NITF02.10".ljust(400) + b"IMSIDD001001 SICD", "is a SIDD file"),
    "NITF": ("x.ntf", b"NSIF01.00".ljust(400), "is a NITF file, an image"),
    "HDF5": ("x.h5", HDF5, "is an HDF5 file (as those of ICEYE and COSMO-SkyMed); read it with h5py"),
    "HDF5 behind 512 bytes": ("x.h5", bytes(511) + b" " + HDF5, "is an HDF5 file"),
    "netCDF 4": ("x.nc", HDF5, "is a netCDF 4 file (HDF5); read it with xarray.open_dataset"),
    "netCDF 3": ("x.nc", b"CDF\1" + bytes(40), "is a netCDF 3 file"),
    "MATLAB 7.3": ("x.mat", b"MATLAB 7.3 MAT-file, HDF5 schema 1.00 .".ljust(512) + HDF5, "is a MATLAB 7.3 file"),
    "MATLAB 4": ("x.mat", written(lambda b: scipy.io.savemat(b, ROW, format="4")), "is a MATLAB 4 file; read it with"),
    "TIFF": ("x.tif", b"II*\0" + bytes(400), "is a TIFF file, an image; give the CPHD file"),
    "BigTIFF": ("x.tif", b"MM\0+" + bytes(400), "is a TIFF file"),
    "zip": ("x.zip", zipped("collect.cphd"), "is a zip archive; unpack it first: unzip"),
    "SAFE in zip": ("S1.zip", zipped("S1A_IW_RAW__0SDV.SAFE/manifest.safe"), "is a SAFE product in a zip archive"),
    "npz": ("x.npz", written(lambda b: np.savez(b, **ROW)), "of several numpy arrays (npz); read it with numpy.load"),
    "npy": ("x.npy", written(lambda b: np.save(b, ROW["a"])), "is a numpy array (npy)"),
    "pickle": ("x.pkl", pickle.dumps(ROW), "is a pickle of Python; read it with pickle.load"),
    "gzip": ("x.cphd.gz", gzip.compress(CPHD), "is a file compressed by gzip; unpack it first: gzip -dc"),
    "tar": ("x.tar", tarred("w"), "is a tar archive; unpack it first: tar -xf"),
    "tar.gz": ("x.tgz", tarred("w:gz"), "is a tar archive"),
    "bzip2": ("x.bz2", bz2.compress(CPHD), "is a file compressed by bzip2"),
    "xz": ("x.xz", lzma.compress(CPHD), "is a file compressed by xz"),
    "zstd": ("x.zst", b"\x28\xb5\x2f\xfd" + bytes(40), "is a file compressed by zstd; unpack it first: zstd -dc"),
    "7z": ("x.7z", b"7z\xbc\xaf\x27\x1c" + bytes(40), "is a 7z archive; unpack it first: 7z x"),
    "HTML": (
        "x.cphd",
        b"\n<!DOCTYPE html>\n<html><head><title>403\nForbidden</title>",
        "is a web page (403 Forbidden)",
    ),
    "error of S3": (
        "x.cphd",
        b'<?xml version="1.0"?>\n<Error><Code>AccessDenied</Code></Error>',
        "server (AccessDenied)",
    ),
    "XML": ("x.xml", b'<?xml version="1.0"?>\n<product>\n</product>', "is an XML file (product); give the data"),
    "JSON": ("x.json", b'{"id": 3}', "is a JSON file; give the data that it describes"),
    "STAC": ("x.json", b'{"type": "Feature", "stac_version": "1.0.0"}', "is a STAC item (JSON); get the CPHD file"),
    "Git LFS": ("x.cphd", b"version https://git-lfs.github.com/spec/v1\noid sha256:a\n", "is a Git LFS pointer"),
    "empty": ("x.cphd", b"", "is an empty file; get it again"),
    "zeros": ("x.cphd", bytes(100_000), "is a file that begins with zeros only, as after an interrupted download; get"),
    "PNG": ("x.png", b"\x89PNG\r\n\x1a\n" + bytes(40), "is a PNG picture; give the CPHD file"),
    "JPEG": ("x.jpg", b"\xff\xd8\xff\xe0" + bytes(40), "is a JPEG picture"),
    "PDF": ("x.pdf", b"%PDF-1.7\n", "is a PDF document; give the data that it describes"),
    "CEOS image": (
        "IMG-HH-ALPSRP",
        ceos(b"\x32\xc0\x12\x12", b"\x32\x0b\x12\x14"),
        "is a CEOS file of an image; give the CP",
    ),
    "CEOS leader": ("LED-ALPSRP", ceos(b"\x0b\xc0\x12\x12", b"\x12\x0a\x12\x14"), "(volume, leader or trailer); give"),
    "ENVISAT raw": ("ASA.N1", b'PRODUCT="ASA_IM__0PNPDK20', "is an ENVISAT or ERS product of level 0; decode its"),
    "ENVISAT image": ("ASA.N1", b'PRODUCT="ASA_IMS_1PNPDK20', "is an ENVISAT or ERS product, an image"),
    "COSAR": ("x.cos", bytes(20).replace(b"\0", b"\1") + bytes(8) + b"CSAR", "is a COSAR file (TerraSAR-X), an image"),
    "parquet": ("x.parquet", b"PAR1" + bytes(40), "is a parquet file"),
    "CSV": ("x.csv", b"time,x,y\n0,1,2\n", "is a table in text (CSV); read it with numpy.genfromtxt"),
    "text": ("x.txt", "Höhe über Grund\n".encode(), "is a text file"),
    "zarr.json": ("zarr.json", b'{"zarr_format": 3}', "is metadata of a zarr store; give the folder"),
    "anything": (
        "x.bin",
        np.arange(1.5, 90).astype("<f4").tobytes(),
        "is of no kind that blocksar knows (it begins with",
    ),
}


def refusal(command: Callable[..., object], *arguments: object) -> str:
    with pytest.raises(InputError) as error:
        command(*arguments)
    return str(error.value)


@pytest.mark.parametrize("what", FILES)
def test_a_file_of_another_kind_is_named_alike_by_every_command(what: str, tmp_path: Path) -> None:
    name, data, sentence = FILES[what]
    (path := tmp_path / name).write_bytes(data)
    said = refusal(blocksar.info, path)
    assert said.startswith(f"{path} is ") and sentence in said and said.count(";") == 1
    out = tmp_path / "new.zarr"
    for command, *arguments in (
        (blocksar.ingest, "cphd", path, out),
        (blocksar.ingest, "gotcha", path, out),
        (blocksar.plan, path),
        (blocksar.check, path),
        (blocksar.focus, path, out),
    ):
        assert refusal(command, *arguments) == said  # type: ignore[arg-type]
    assert not out.exists()


def test_a_matlab_file_of_another_set_is_said_to_be_none_of_gotcha(tmp_path: Path) -> None:
    scipy.io.savemat(path := tmp_path / "mine.mat", ROW)
    assert "it has no variable `data`, so it is not of the Gotcha set; read it with scipy" in refusal(
        blocksar.info, path
    )
    assert "`blocksar ingest gotcha" in refusal(blocksar.ingest, "cphd", path, tmp_path / "new")


@pytest.mark.parametrize("what", ["gzip", "bzip2", "xz", "tar", "tar.gz", "zip"])
def test_what_is_said_of_an_archive_unpacks_it(what: str, tmp_path: Path) -> None:
    name, data, _ = FILES[what]
    (path := tmp_path / f"with blanks {name}").write_bytes(data)
    command = refusal(blocksar.info, path).partition("unpack it first: ")[2]
    if shutil.which(command.partition(" ")[0]) is None:
        pytest.skip(f"{command.partition(' ')[0]} is not installed")
    subprocess.run(command, shell=True, check=True, cwd=tmp_path, stdout=subprocess.DEVNULL)
    new = [each for each in tmp_path.iterdir() if each != path]
    assert [each.read_bytes() for each in new] == [CPHD]


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        (
            {"README.txt": b"text", "collect.cphd": CPHD, "look.png": b"\x89PNG\r\n\x1a\n"},
            "collect.cphd is a CPHD file; turn",
        ),
        ({"a.xml": b"<a/>", "x.h5": HDF5}, "is a folder, no phase history: "),
    ],
)
def test_a_folder_is_told_by_the_data_in_it(files: dict[str, bytes], sentence: str, tmp_path: Path) -> None:
    (folder := tmp_path / "S1A_IW_RAW__0SDV.SAFE").mkdir()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    said = refusal(blocksar.info, folder)
    assert sentence in said
    assert refusal(blocksar.plan, folder) == said == refusal(blocksar.ingest, "cphd", folder, tmp_path / "new")


def test_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert readers.found_at(LocalPlace(tmp_path / "pipe")) is None
    assert "is no regular file; give the path of a CPHD file" in refusal(
        blocksar.ingest, "cphd", tmp_path / "pipe", tmp_path / "new"
    )
    assert readers.found_at(LocalPlace(tmp_path / "nothing")) is None


@pytest.mark.parametrize("cut", [1, 3, 13, 29, 127, 300, 1000])
def test_no_beginning_fails(cut: int, tmp_path: Path) -> None:
    for number, (name, data, _) in enumerate(FILES.values()):
        (path := tmp_path / f"{number}{name}").write_bytes(data[:cut])
        assert readers.found_at(LocalPlace(path)) is not None
