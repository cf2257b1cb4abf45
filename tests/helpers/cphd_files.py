"""A small CPHD file with its contents, whose parts tests change; and the checker of the standard."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from lxml import etree
from numpy.typing import NDArray
from sarkit import cphd as skcphd
from sarkit.verification import CphdConsistency

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.readers import registry as readers
from blocksar.readers.cphd import Choices
from blocksar.readers.cphd.reader import CPHD
from blocksar.readers.reading import Ingested
from blocksar.simulation import cphd as cphd_simulation
from blocksar.simulation.scatterers import simulate_pulses
from blocksar.simulation.scene import Scene

Array = NDArray[Any]

SCENE = """
title = "small"
[radar]
carrier = 10e9
bandwidth = 100e6
range_sampling = 120e6
prf = 400.0
[track]
position = [0.0, 0.0, 5000.0]
velocity = [10.0, 120.0, -5.0]
acceleration = [1.0, 0.5, 0.3]
[time]
pulses = 160
[scene]
swath = [7920.0, 8080.0]
centre_yaw_deg = 20.0
reference_range = "constant"
[[targets]]
name = "one"
ground_range_offset = 10.0
cross_range_offset = -15.0
[[targets]]
name = "two"
ground_range_offset = -30.0
cross_range_offset = 20.0
amplitude = 0.5
phase_deg = 70.0
"""
ORIGIN = (-33.5, 151.2, 40.0)


class Base(NamedTuple):
    """A small CPHD file and its contents."""

    path: Path
    scene: Scene
    targets: Array  # (n, 3) m, relative to the scene's centre
    sigma: Array


def failures(path: Path) -> list[str]:
    """What the checker finds wrong with a file, one line each."""
    with open(path, "rb") as file:
        checker = CphdConsistency.from_file(file, thorough=True)
        checker.check()
    assert len(checker.passes()) > 50
    return [f"{name}: {found}" for name, found in checker.failures().items()]


def small_file(folder: Path) -> Base:
    """Write the file."""
    (folder / "scene.toml").write_text(SCENE)
    path = cphd_simulation.simulate(folder / "scene.toml", folder / "small.cphd", origin=ORIGIN)
    scene = Scene.read(folder / "scene.toml")
    points = scene.point_targets()
    targets = np.array([[t.x, t.y, scene.area.ground_height] for t in points]) - scene.centre
    return Base(path, scene, targets, np.array([t.reflectivity for t in points]))


# ---------------------------------------------------------------- Editing the parts of a CPHD


class Parts(NamedTuple):
    root: Any
    vectors: Array
    samples: Array

    def set(self, path: str, text: Any) -> None:
        (node,) = self.root.findall("/".join(f"{{*}}{part}" for part in path.split("/")))
        node.text = str(text)

    def insert(self, path: str, before: str, text: str) -> None:
        parent, name = path.rsplit("/", 1)
        (node,) = self.root.findall("/".join(f"{{*}}{part}" for part in parent.split("/")))
        (follower,) = node.findall(f"{{*}}{before}")
        child = follower.makeelement(follower.tag.replace(before, name))
        child.text = text
        follower.addprevious(child)


def parts_of(path: Path) -> Parts:
    with open(path, "rb") as file:
        reader = skcphd.Reader(file)
        samples, vectors = reader.read_channel("1")
    native = vectors.astype(vectors.dtype.newbyteorder("="))
    return Parts(reader.metadata.xmltree.getroot(), native, samples.astype(np.complex64))


def write(path: Path, parts: Parts, fields: dict[str, str] | None = None) -> Path:
    """Write parts with sarkit; `fields` are additional per-vector parameters with their formats."""
    root, vectors, samples = parts
    names = {name: vectors.dtype[name] for name in vectors.dtype.names or ()}
    for name, form in (fields or {}).items():
        pvp = root.find("{*}PVP")
        follower = pvp.find({"AmpSF": "{*}aFDOP"}[name])
        node = follower.makeelement(follower.tag.replace("aFDOP", name))
        follower.addprevious(node)
        offset = int(root.findtext("{*}Data/{*}NumBytesPVP")) // 8
        for key, value in (("Offset", offset), ("Size", 1), ("Format", form)):
            child = etree.SubElement(node, follower.tag.replace("aFDOP", key))
            child.text = str(value)
        root.find("{*}Data/{*}NumBytesPVP").text = str(8 * offset + 8)
    root.find("{*}Data/{*}Channel/{*}NumVectors").text = str(samples.shape[0])
    root.find("{*}Data/{*}Channel/{*}NumSamples").text = str(samples.shape[1])
    made = np.zeros(vectors.size, skcphd.get_pvp_dtype(root.getroottree()))
    for name in names:
        made[name] = vectors[name]
    with open(path, "wb") as file:
        writer = skcphd.Writer(file, skcphd.Metadata(xmltree=root.getroottree()))
        writer.write_signal("1", np.ascontiguousarray(samples))
        writer.write_pvp("1", made)
    return path


def delays(parts: Parts, base: Base) -> Array:
    """Two-way delay of every target relative to that of the SRP, (n_vector, n_target) s."""
    frame = Georeference(latitude=ORIGIN[0], longitude=ORIGIN[1], height=ORIGIN[2])
    ground = frame.to_ecef(base.targets)
    v = parts.vectors

    def way(points: Array) -> Array:
        out = np.linalg.norm(points - v["TxPos"][:, None], axis=-1)
        return np.asarray((out + np.linalg.norm(points - v["RcvPos"][:, None], axis=-1)) / SPEED_OF_LIGHT)

    return np.asarray(way(ground[None]) - way(v["SRPPos"][:, None]))


def echo(fx: Array, dtoa: Array, sigma: Array, sign: int) -> Array:
    """The signal at frequencies (n_vector, n_sample), from the definition in the standard.

    Where the phase increases with delay (sign +1), the same target has the conjugate reflectivity.
    """
    total = np.zeros(fx.shape, np.complex128)
    for one, late in zip(sigma if sign < 0 else sigma.conj(), dtoa.T, strict=True):
        total += one * np.exp(2j * np.pi * sign * fx * late[:, None])
    return total


def grid_of(parts: Parts) -> Array:
    n = parts.samples.shape[1]
    return np.asarray(parts.vectors["SC0"][:, None] + parts.vectors["SCSS"][:, None] * np.arange(n))


def expected(collection: Collection, base: Base) -> Array:
    """The expected content of the store, by the definition of the phase history."""
    return simulate_pulses(collection, base.targets[:, 0], base.targets[:, 1], base.sigma)


def ingest(path: Path, out: Path, *, overwrite: bool = False, progress: Any = None, **options: Any) -> Ingested:
    """Ingest a file by its reader."""
    choices = options.pop("choices", Choices())
    choices = replace(choices, **options)
    return readers.ingest(CPHD, [path], out, choices, overwrite=overwrite, progress=progress)


def ingested(path: Path, **options: Any) -> tuple[Collection, Array, list[str], dict[str, Any]]:
    out = path.with_suffix(".zarr")
    made = ingest(path, out, overwrite=True, **options)
    history = stores.open_phase_history(out)
    return history.collection, history.read(slice(None), slice(None)), made.messages, history.attrs


def refused(path: Path, match: str, **options: Any) -> str:
    """Check that the error is one sentence that names the file, and that nothing is written."""
    out = path.parent / "refused.zarr"
    with pytest.raises(InputError, match=match) as caught:
        ingest(path, out, **options)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 500
    assert path.name in text
    assert not out.exists()
    assert [p.name for p in path.parent.iterdir() if p.name.startswith(".")] == []
    return text


def xml(path: str, text: Any) -> Callable[[Parts], None]:
    return lambda parts: parts.set(path, text)


def vectors(name: str, value: Any, where: Any = slice(None)) -> Callable[[Parts], None]:
    def change(parts: Parts) -> None:
        parts.vectors[name][where] = value

    return change


def without(path: str) -> Callable[[Parts], None]:
    def change(parts: Parts) -> None:
        (node,) = parts.root.findall("/".join(f"{{*}}{part}" for part in path.split("/")))
        node.getparent().remove(node)

    return change
