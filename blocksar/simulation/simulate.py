"""Simulation of a scene into a phase-history store, as range-frequency samples or raw echo, with exact ranges.

No range is expanded in a series. Point targets are summed directly. Random fields and maps of up to millions of
scatterers use a non-uniform Fourier transform: in each pulse, the signal over range frequency is the Fourier transform
of the reflectivity over range, and the ranges lie on no grid. Ranges and phases are float64, samples complex64.

Every pulse is computed independently, in blocks of fixed size: the samples depend neither on the number of threads nor
on the division of the pulses into chunks.

Where the scene gives an error of the track, samples come from the track as flown, and the store has the track as known.
The track as flown then lies beside the store, in `truth_place`, and nothing in the store tells of it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError
from blocksar.measurement.targets import Target
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.progress.listening import Callback
from blocksar.simulation.scatterers import Field, field, phase_history, raw_echo
from blocksar.simulation.scene import RANGE_GUARD, Scene
from blocksar.simulation.scene_tables import factor, of_channel

MAX_NAMED_TARGETS = 2000  # with more, the store's attributes do not list them


def noise(shape: tuple[int, int], *, first_pulse: int, power: float, seed: int) -> ComplexArray:
    """Generate circular Gaussian noise, E|n|^2 = power: (n_pulse, n) complex64.

    The generator is keyed by (seed, pulse), so that a pulse's noise does not depend on the division into chunks.
    """
    out = np.empty(shape, np.complex64)
    scale = np.float32(np.sqrt(power / 2))
    for row in range(shape[0]):
        random = np.random.Generator(np.random.Philox(key=np.array([seed, first_pulse + row], dtype=np.uint64)))
        out[row] = (random.standard_normal(2 * shape[1], dtype=np.float32) * scale).view(np.complex64)
    return out


def simulate(
    scene: Scene | str | os.PathLike[str],
    out: Location,
    *,
    raw: bool = False,
    threads: int = 1,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> Path | Place:
    """Simulate a scene into a phase-history store by chunks of pulses, in bounded memory.

    Parameters
    ----------
    scene : Scene, or path of a scene file, or name of a shipped scene
    out : path, URL or Place
        The store to create.
    raw : bool
        Store the chirped echo over fast time instead of range-frequency samples.
    threads : int
        Number of threads; the samples do not depend on it.
    overwrite : bool
        Replace an existing store.
    progress : callable (done, total)
        Called after each chunk with the numbers of finished pulses and of all pulses.

    Returns
    -------
    Path
        The store; a Place if it lies in an object store.

    Raises
    ------
    InputError
        If the scene is wrong, or `out` exists and overwrite is False.
    """
    if threads < 1:
        raise InputError(f"threads = {threads}: must be at least 1")
    scene = scene if isinstance(scene, Scene) else Scene.read(os.fspath(scene))
    where = place(out)
    collection = scene.collection(raw=raw)
    echo = _echo_axes(scene) if raw else None
    n = collection.n_range_frequency if echo is None else echo.fast_time.size
    count, name, rows = max(len(scene.channels), 1), "echo" if raw else "signal", TILE[0]

    def write(store: Place) -> None:
        for channel in range(count):
            sample = sampler(of_channel(scene, channel), collection, echo=echo, threads=threads)
            for first in range(0, collection.n_pulse, rows):
                pulses = slice(first, min(first + rows, collection.n_pulse))
                lead = (slice(channel, channel + 1),) if scene.channels else ()
                samples = sample(pulses)
                stores.write_region(store, name, (*lead, pulses, slice(0, n)), samples[None] if lead else samples)
                if progress is not None:
                    progress(channel * collection.n_pulse + pulses.stop, count * collection.n_pulse)
        write_truth(scene, where)

    # Rows not yet written would read as lost pulses: the store therefore gets its name when it is complete.
    stores.create_phase_history(
        where, collection, raw=echo, channels=scene.channels, attrs=_attributes(scene), overwrite=overwrite, fill=write
    )
    return where.path if isinstance(where, LocalPlace) else where


def sampler(
    scene: Scene, collection: Collection, *, echo: RawEcho | None = None, threads: int = 1
) -> Callable[[slice], ComplexArray]:
    """Return a function that simulates a slice of pulses: samples as stored, with noise and lost pulses.

    `collection` is the scene's own, or one that differs from it in frequencies and reference range.
    """
    n = collection.n_range_frequency if echo is None else echo.fast_time.size
    parts, lost = _scatterers(scene, as_flown(scene, collection), threads), scene.dropped_pulses()

    def sample(pulses: slice) -> ComplexArray:
        samples = _samples(parts, echo, n, pulses, threads)
        _disturb(samples, scene, lost, pulses)
        return samples

    return sample


def as_flown(scene: Scene, collection: Collection) -> Collection:
    """Return the collection with the antenna's true positions; unchanged if the track has no error.

    Raises
    ------
    InputError
        If the error is as large as the guard of the range window.
    """
    if scene.track.error is None:
        return collection
    error = scene.track.error.positions(collection.time)
    largest = float(np.sqrt((error * error).sum(axis=1)).max())
    room = (1 - 1 / RANGE_GUARD) * collection.range_window / 2
    if largest >= room:
        raise InputError(
            f"track.error reaches {largest:.3g} m: must stay below {room:.3g} m, or echoes leave the range window; "
            "make it smaller, or scene.swath wider"
        )
    positions = {"antenna_position": collection.antenna_position + error}
    return Collection(**{**collection.as_dict(), **positions})


def truth_place(out: Location) -> Place:
    """Return where the track as flown lies: PH.truth.zarr beside PH.zarr or PH.cphd."""
    return place(str(place(out)).removesuffix(".zarr").removesuffix(".cphd") + ".truth.zarr")


def write_truth(
    scene: Scene, out: Location, carried: Callable[[FloatArray], FloatArray] = lambda positions: positions
) -> None:
    """Write the true track beside a phase history; remove an earlier one if the track has no error.

    `carried` turns positions (n, 3), m, into those in the frame of the phase history, if that is not the scene's.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    truth = truth_place(out)
    if scene.track.error is None:
        if (truth / "zarr.json").exists() and stores.is_truth(truth):
            truth.remove()
        return
    flown = as_flown(scene, scene.collection()).antenna_position
    stores.write_truth(truth, scene.pulse_times, carried(flown))


def _echo_axes(scene: Scene) -> RawEcho:
    fast_time, pulse_width = scene.fast_time, scene.radar.pulse_width
    assert pulse_width is not None  # fast_time has checked that
    return RawEcho(
        fast_time=fast_time,
        chirp_rate=scene.radar.bandwidth / pulse_width,
        pulse_width=pulse_width,
        sampling_rate=scene.radar.range_sampling,
    )


def _scatterers(scene: Scene, collection: Collection, threads: int) -> list[tuple[Field, bool]]:
    """Return point targets, and random field with map, as `Field`s; each with whether its raw echo is exact."""
    points, many, terrain, hiding = scene.point_targets(), scene.scatterers(), scene.terrain, scene.hiding_terrain
    parts = []
    if points:
        _, x, y, sigma, z = (np.array(column) for column in zip(*points, strict=True))
        raised = None
        if any(height is not None for height in z):
            raised = np.array([collection.ground_height if height is None else height for height in z])
        parts.append((field(collection, x, y, sigma, raised, terrain=hiding, threads=threads), True))
    if many.x.size:
        ground = None if terrain is None else terrain(many.x, many.y)
        seen = field(collection, many.x, many.y, many.reflectivity, ground, terrain=hiding, threads=threads)
        parts.append((seen, False))
    return parts


def _samples(
    parts: list[tuple[Field, bool]], echo: RawEcho | None, n: int, pulses: slice, threads: int
) -> ComplexArray:
    """Sum the echoes of all scatterers, (n_pulses, n) complex64."""
    total = np.zeros((pulses.stop - pulses.start, n), np.complex64)
    for scatterers, exact in parts:
        if echo is None:
            total += phase_history(scatterers, pulses=pulses, threads=threads)
        else:
            total += raw_echo(
                scatterers,
                fast_time=echo.fast_time,
                chirp_rate=echo.chirp_rate,
                pulse_width=echo.pulse_width,
                pulses=pulses,
                threads=threads,
                exact=exact,
            )
    return total


def _disturb(samples: ComplexArray, scene: Scene, lost: NDArray[np.int64], pulses: slice) -> None:
    """Add noise to newly computed samples and set rows of lost pulses to NaN, in place."""
    if scene.noise is not None and scene.noise.power > 0:
        samples += noise(samples.shape, first_pulse=pulses.start, power=scene.noise.power, seed=scene.noise.seed)
    samples[lost[(lost >= pulses.start) & (lost < pulses.stop)] - pulses.start] = complex(np.nan, np.nan)


def _attributes(scene: Scene) -> dict[str, Any]:
    """Return the store's attributes about its scene: name, targets (unless there are many), noise and seeds."""
    attrs: dict[str, Any] = {"scene": scene.name, "noise": scene.noise.power if scene.noise else 0.0}
    if scene.area.frame:
        attrs["frame"] = scene.area.frame
    if scene.georeference is not None:
        attrs["georeference"] = scene.georeference.as_attribute()
    tables = (scene.clutter, scene.reflectivity, scene.noise, scene.dropped)
    named = zip(("clutter", "reflectivity", "noise", "dropped"), tables, strict=True)
    attrs["seed"] = {name: table.seed for name, table in named if table is not None and table.seed is not None}
    targets = scene.point_targets()
    if len(targets) <= MAX_NAMED_TARGETS:
        attrs["targets"] = [Target(*target).as_record() for target in targets]
        for entry, target in zip(attrs["targets"], scene.targets, strict=False):
            if target.scattering:
                seen = {name: target.reflectivity * factor(target, name) for name in scene.channels}
                entry["channels"] = {name: [sigma.real, sigma.imag] for name, sigma in seen.items()}
    return attrs
