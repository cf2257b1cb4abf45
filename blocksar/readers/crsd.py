"""Raw echoes in CRSD files (NGA.STND.0080, version 1.0): CRSDsar, of one transmitter and monostatic, with linear FM.

A pulse has the phase PhiX0 + FxFreq0 u + FxRate u^2 / 2 in cycles, u after its centre at TxTime; a vector's sample at t
lacks RefPhi0 + RefFreq (t - RcvStart). An echo that comes after tau thus has

    PhiX0 - RefPhi0 + FxFreq0 (t - TxTime - tau) + FxRate (t - TxTime - tau)^2 / 2 - RefFreq (t - RcvStart) ,

and, with what does not depend on tau taken off, the phase -FxFreq0 tau and the chirp about it, as a raw echo has them.

The phase centre is midway between the transmitter at TxTime and the receiver when the scene's echo arrives, as in CPHD.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, library_for, printable, quoted
from blocksar.options import Option
from blocksar.places.ranges import Readable
from blocksar.readers.kinds import Kind, begins
from blocksar.readers.orbit import Antenna, OrbitTrack, epoch_of
from blocksar.readers.reading import reading
from blocksar.readers.registry import refuse_few, refuse_others
from blocksar.readers.strips import Even, PartOptions, RawStrip, StripReader, even_pulses
from blocksar.texts import count

KIND = Kind(
    "a CRSD file", begins(b"CRSDsar/", b"CRSDrcv/", b"CRSDtx/", b"CRSD/"),
    "turn it into a phase history first: `blocksar ingest crsd {path} --out {store}`",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CrsdOptions(PartOptions):
    """Options of the CRSD reader, besides `PartOptions`.

    Attributes
    ----------
    channel : str, optional
        Identifier of the channel. Needed if several have the polarisation.
    """

    channel: Annotated[
        str | None, Option("Channel to read, if the file has several of a polarisation.", metavar="NAME")
    ] = None


FORMATS = {"CI2": "i1", "CI4": ">i2", "CF8": ">f4"}
SIDES = {"L": "left", "R": "right"}
WAVEFORM = 1e-6  # relative change of chirp or frequencies over the pulses that is none
APART = 0.05  # samples, by which a vector's first sample may lie off the axis of all
BISTATIC = 2e-3  # of the range, that transmitter and receiver may be apart


@contextmanager
def opened(path: Readable) -> Iterator[tuple[Any, Any]]:
    """Open the file with sarkit's reader.

    Raises
    ------
    InputError
        If it is of another kind or damaged, or sarkit is not installed.
    """
    with library_for("CRSD files need", "formats"):
        import sarkit.crsd
    with reading(path, damaged="damaged, or no CRSD 1.0 file", remedy="get it again"):
        refuse_others(path, KIND)
        with path.open() as stream:
            yield stream, sarkit.crsd.Reader(stream)


def begin(files: Sequence[Readable], options: CrsdOptions) -> RawStrip:
    """Read everything but the samples.

    Raises
    ------
    InputError
        If the file is damaged, not supported or contradicts itself.
    """
    [path] = files
    with opened(path) as (stream, reader), np.errstate(all="ignore"):
        return _Layout(path, stream, reader, options).strip().taking(options)


def _vectors(values: NDArray[Any]) -> FloatArray:
    """Convert parameters of three numbers to (n, 3), from either way of storing them."""
    if values.dtype.names is not None:
        return np.stack([values[name].astype(float) for name in values.dtype.names], axis=1)
    return values.astype(float)


def _whole(values: NDArray[Any], origin: int = 0) -> FloatArray:
    """Add whole numbers, minus an origin, and fractions of times or phases."""
    return np.asarray((values["Int"] - origin).astype(float) + values["Frac"])


class _Layout:
    """Access to the parts of a CRSD file that a strip needs."""

    def __init__(self, path: Readable, stream: Any, reader: Any, options: CrsdOptions) -> None:
        self.path, self.stream, self.reader, self.options = path, stream, reader, options
        self.root = reader.metadata.xmltree.getroot()
        kind = str(self.root.tag).rpartition("}")[2]
        if kind != "CRSDsar":
            raise InputError(f"is of kind {quoted(kind)}, without echoes and their pulses; give a CRSDsar file")
        self.parameters = self._channel()
        self.notes: list[str] = []

    def said(self, path: str, of: Any = None) -> str:
        """Text at a path of the XML; empty if there is none."""
        parts = "/".join(f"{{*}}{name}" for name in path.split("/"))
        return printable(((self.root if of is None else of).findtext(parts) or "").strip())

    def _polarization(self, parameters: Any) -> str:
        """Polarisation of transmitter and receiver, such as HV; L and R are circular."""
        names = (
            self.said(f"{path}/PolarizationID", parameters) for path in ("SARImage/TxPolarization", "RcvPolarization")
        )
        return "".join({"LHC": "L", "RHC": "R"}.get(name, name) for name in names)

    def _channel(self) -> Any:
        """Parameters of the requested channel.

        Raises
        ------
        InputError
            If there is none, or several.
        """
        found = {self.said("Identifier", each): each for each in self.root.findall("{*}Channel/{*}Parameters")}
        wanted = {
            name: each for name, each in found.items()
            if self.options.channel in (None, name)
            and self.options.polarization in (None, self._polarization(each))
        }  # fmt: skip
        if len(wanted) != 1:
            listed = ", ".join(f"{name} ({self._polarization(each)})" for name, each in found.items())
            which = "none" if not wanted else f"{len(wanted)}"
            raise InputError(f"has the channels {listed}, {which} of which are meant; give --channel NAME")
        return next(iter(wanted.values()))

    def strip(self) -> RawStrip:
        name = self.said("Identifier", self.parameters)
        data = next(
            each for each in self.root.findall("{*}Data/{*}Receive/{*}Channel") if self.said("ChId", each) == name
        )
        vectors = self.reader.read_pvps(name)
        pulses = self.reader.read_ppps(self.said("SARImage/TxId", self.parameters))
        first = slice(*slice(*self.options.pulses).indices(vectors.size))
        order = np.arange(vectors.size)[first]
        sent = pulses[vectors["TxPulseIndex"]]
        origin = int(sent["TxTime"]["Int"][0])
        time = _whole(sent["TxTime"], origin)
        even, notes = even_pulses(time[order])
        even = even.of_file(order)
        lost = np.flatnonzero(vectors["SIGNAL"][even.pulses] != 1) if "SIGNAL" in vectors.dtype.names else order[:0]
        if lost.size:
            n = even.pulses.size
            refuse_few(n - lost.size, n, "vectors have no normal signal", "take others with --pulses")
            notes.append(f"{lost.size} of {count(n, 'vector')} without a normal signal: missing in the store")
            even = even.without(lost)
        self.notes += notes
        transmit, when = sent[even.pulses], vectors[even.pulses]
        width, rate, carrier = (self._constant(transmit, field) for field in ("TXmt", "FxRate", "FxFreq0"))
        if np.any(when["FICRate"] != 0):
            raise InputError("has echoes that were mixed with a chirp (FICRate is not 0); compress them first")
        sampling_rate = float(self.said("Fs", self.parameters))
        n_sample = int(self.said("NumSamples", data))
        begun = _whole(when["RcvStart"], origin) - time[even.pulses]
        off = np.abs(begun - begun[0]).max() * sampling_rate
        if off > APART:
            raise InputError(
                f"receive windows move by {off:.3g} samples after the pulses; take pulses of one with --pulses"
            )
        delay = float(begun.mean()) + np.arange(n_sample) / sampling_rate + width / 2
        centre = _vectors_of(self.root, "SceneCoordinates/IARP/ECF")
        track = self._track(even, transmit, when, begun, centre)
        start = epoch_of(self.said("Global/CollectionRefTime"), "CollectionRefTime")
        axis, steering = self._antenna(transmit, track, even)
        form = self.said("Data/Receive/SignalArrayFormat")
        if form not in FORMATS:
            raise InputError(f"has samples in {quoted(form)}; only {', '.join(FORMATS)} are read")
        signals = int(self.reader._kvp_list["SIGNAL_BLOCK_BYTE_OFFSET"])
        samples = _Samples(
            path=self.path, dtype=np.dtype(FORMATS[form]), count=n_sample,
            first_byte=signals + int(self.said("SignalArrayByteOffset", data)),
            numbers=even.pulses, scale=when["AmpSF"].astype(float) if "AmpSF" in when.dtype.names else None,
            phase=self._phase(transmit, when, begun), mixed=float(carrier - when["RefFreq"][0]),
            delay=delay - width / 2,
        )  # fmt: skip
        self.stream.seek(0, 2)
        if self.stream.tell() < samples.first_byte + vectors.size * n_sample * 2 * samples.dtype.itemsize:
            raise InputError("ends before its samples do; get it again")
        return RawStrip(
            title=self.said("ProductInfo/ProductName"), format="CRSD 1.0",
            collector=self.said("ReceiveInfo/SensorName"),
            epoch=start + timedelta(seconds=origin), even=even, tags="middle", orbit=track, antenna=axis,
            length=None, side=self._side(), delay=delay, chirp_rate=rate, pulse_width=width, carrier=carrier,
            sampling_rate=sampling_rate, polarizations=(self._polarization(self.parameters),), read=samples,
            notes=self.notes, steering=steering, origin=Georeference.at(centre),
        )  # fmt: skip

    def _constant(self, pulses: NDArray[Any], name: str) -> float:
        """Value of a parameter of pulses that must be constant."""
        values = pulses[name].astype(float)
        if not np.isfinite(values).all() or np.ptp(values) > WAVEFORM * np.abs(values).max():
            raise InputError(
                f"PPP {name} is {values.min():.9g} .. {values.max():.9g}; only equal pulses are read: take some "
                "with --pulses"
            )
        return float(values.mean())

    def _side(self) -> str:
        side = self.said("ReferenceGeometry/SARImage/SideOfTrack")
        if side not in SIDES:
            raise InputError(f"SideOfTrack is {quoted(side)}; it must be L or R")
        return SIDES[side]

    def _track(
        self, even: Even, pulses: NDArray[Any], vectors: NDArray[Any], begun: FloatArray, centre: FloatArray
    ) -> OrbitTrack:
        """Positions midway between transmitter and receiver, at the time the scene's echo arrives."""
        transmitter, receiver = _vectors(pulses["TxPos"]), _vectors(vectors["RcvPos"])
        velocity = _vectors(vectors["RcvVel"])
        away = np.linalg.norm(transmitter - centre, axis=1)
        later = 2 * away / SPEED_OF_LIGHT - begun
        receiver = receiver + velocity * later[:, None]
        apart = float((np.linalg.norm(transmitter - receiver, axis=1) / away).max())
        if not apart < BISTATIC:
            raise InputError(f"transmitter and receiver lie {100 * apart:.3g} % of the range apart: this is bistatic, "
                             "and only monostatic collections are supported")  # fmt: skip
        return OrbitTrack(
            time=even.sent, position=(transmitter + receiver) / 2,
            velocity=(_vectors(pulses["TxVel"]) + velocity) / 2,
        )  # fmt: skip

    def _antenna(self, pulses: NDArray[Any], track: OrbitTrack, even: Even) -> tuple[Antenna | None, FloatArray | None]:
        """Azimuth axis of the transmitting antenna, closest to the flight, and the beam's angle off its normal."""
        if not {"TxACX", "TxACY", "TxEB"} <= set(pulses.dtype.names or ()):
            return None, None
        axes = np.stack([_vectors(pulses[name]) for name in ("TxACX", "TxACY")])
        along = (axes * track.velocity).sum(axis=2).mean(axis=1)
        which = int(np.argmax(np.abs(along)))
        towards = np.sign(along[which])
        sine = towards * _vectors(pulses["TxEB"])[:, which]
        steering = np.interp(even.time, even.sent, np.arcsin(np.clip(sine, -1, 1)))
        return Antenna(time=track.time, axis=towards * axes[which]), steering

    def _phase(self, pulses: NDArray[Any], vectors: NDArray[Any], begun: FloatArray) -> FloatArray:
        """Phase to remove from each vector, cycles (see the package)."""
        reference = _whole(pulses["PhiX0"]) - _whole(vectors["RefPhi0"])
        return np.asarray(np.mod(reference + np.mod(vectors["RefFreq"].astype(float) * begun, 1), 1))


def _vectors_of(root: Any, path: str) -> FloatArray:
    """Read X, Y, Z (3,) at a path of the XML."""
    parts = "/".join(f"{{*}}{name}" for name in path.split("/"))
    return np.array([float(root.findtext(f"{parts}/{{*}}{axis}")) for axis in "XYZ"])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Samples:
    """Reader of a channel's samples."""

    path: Readable
    dtype: np.dtype[Any]
    count: int
    first_byte: int
    numbers: IntArray  # of the vectors that are kept
    scale: FloatArray | None
    phase: FloatArray  # cycles
    mixed: float  # Hz, of the carrier over the reference frequency
    delay: FloatArray  # s after the pulse's centre

    def __call__(self, channel: int, pulses: IntArray) -> ComplexArray:
        size = 2 * self.count * self.dtype.itemsize
        with reading(self.path, damaged="damaged", remedy="get it again"), self.path.open() as stream:
            stream.seek(self.first_byte + int(pulses[0]) * size)
            data = stream.read(size * int(pulses[-1] - pulses[0] + 1))
            rows = np.frombuffer(data, self.dtype).reshape(-1, self.count, 2)[pulses - pulses[0]].astype(np.float32)
        at = np.searchsorted(self.numbers, pulses)
        turn = np.exp(-2j * np.pi * self.phase[at])[:, None]
        if self.mixed:
            turn = turn * np.exp(-2j * np.pi * self.mixed * self.delay)
        if self.scale is not None:
            turn = turn * self.scale[at][:, None]
        return (rows.view(np.complex64)[..., 0] * turn).astype(np.complex64)


CRSD = StripReader(
    name="crsd",
    title="CRSD file",
    summary="Convert a CRSD file, of echoes that are not compressed, to a phase history.",
    example="collect.crsd --out collect.zarr",
    source=("SOURCE.crsd", "CRSD file, version 1.0."),
    kind=KIND,
    options=CrsdOptions,
    begin=begin,
)
