"""Raw echoes of NISAR: level 0B, Radar Raw Signal Data (RRSD), also from other sensors in that layout (HDF5).

Groups and fields are those of files of the mission's emulator. An antenna's frame (RCS) has z along the boresight, x in
elevation and y along the azimuth axis; `quaternions` carry it into Earth-centred axes. `slantRange` is c / 2 times the
delay since transmission began. `UTCtime` is that of transmission where its description says so; where it says nothing,
positions are taken at it, with a note. `basebandPhaseCorrection` multiplies the samples of each pulse, and
`chirpWaveform` is the pulse as the samples hold it (both as isce3 describes them).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, library_for, quoted
from blocksar.options import Option
from blocksar.places.ranges import Readable
from blocksar.readers.chirps import Chirp, fitted_chirp
from blocksar.readers.kinds import Kind, hdf5
from blocksar.readers.orbit import Antenna, Orbit, epoch_of
from blocksar.readers.reading import reading
from blocksar.readers.registry import refuse_few, refuse_others
from blocksar.readers.strips import Even, RawStrip, StripOptions, StripReader, TimeTags, common_window, even_pulses

KIND = Kind(
    "an HDF5 file of NISAR", lambda start: hdf5(start) and b"science" in start.data,
    "turn it into a phase history first: `blocksar ingest nisar {path} --out {store}`",
)  # fmt: skip


def _read_frequency(value: Any) -> str | None:
    if value is not None and str(value).upper() not in ("A", "B"):
        raise InputError(f"--frequency is {quoted(value)}; it must be A or B")
    return None if value is None else str(value).upper()


@dataclass(frozen=True, kw_only=True)
class NisarOptions(StripOptions):
    """Options of the NISAR reader, besides `StripOptions`.

    Attributes
    ----------
    frequency : {"A", "B"}, optional
        Band of the two. Default: "A", or the only one.
    """

    frequency: Annotated[
        str | None, Option("Band of the two.", metavar="A|B", default="A, or the only one", read=_read_frequency)
    ] = None


BANDS = ("LSAR", "SSAR")
LENGTHS = {"ALOS": 8.9, "NISAR": 12.0}  # m, of the antennas of missions, along the track
ECHO = 0  # of calType: the pulse went through the transmitter's amplifier
BENT = 0.3  # rad, of phase at a pulse's ends
CENTRED = 0.01  # of a sample, by which a pulse's centre may lie off the middle of its duration
HALF = 0.5  # of its neighbour's power: a calibration pulse with less has no echo
DAMAGED, REMEDY = "damaged, or no level 0B of NISAR's layout", "get it again"


@contextmanager
def opened(path: Readable) -> Iterator[Any]:
    """Open the file; every failure in the block becomes an error about the file.

    Raises
    ------
    InputError
        If it is of another kind or damaged, or h5py is not installed.
    """
    with library_for("files of NISAR need", "hdf5"):
        import h5py
    with reading(path, damaged=DAMAGED, remedy=REMEDY):
        refuse_others(path, KIND)
        try:
            with path.open() as stream, h5py.File(stream, "r") as file:
                yield file
        except OSError as error:
            if error.errno is not None:
                raise
            raise ValueError(str(error)) from error  # the library's own: a file that is cut


def begin(files: Sequence[Readable], options: NisarOptions) -> RawStrip:
    """Read everything but the samples.

    Raises
    ------
    InputError
        If the file is damaged, not supported or contradicts itself.
    """
    [path] = files
    with opened(path) as file:
        return _Layout(path, file, options).strip().taking(options)


def _text(value: Any) -> str:
    """Convert a text of the file, possibly in an array of one."""
    value = np.asarray(value).ravel()[0]
    return value.decode("utf-8", "replace").strip() if isinstance(value, bytes) else str(value).strip()


class _Layout:
    """Access to the parts of an RRSD file that a strip needs."""

    def __init__(self, path: Readable, file: Any, options: NisarOptions) -> None:
        self.path, self.options = path, options
        science = file.get("science", {})
        band = next((name for name in BANDS if name in science), None)
        if band is None:
            raise InputError("has no group science/LSAR or science/SSAR, as files of NISAR have; give a level 0B file")
        self.identification = science[band].get("identification", {})
        if "RRSD" not in science[band]:
            kind = _text(self.identification["productType"][()]) if "productType" in self.identification else "another"
            raise InputError(f"is a product of NISAR of type {kind}, an image or no echoes; give its level 0B (RRSD)")
        self.root = science[band]["RRSD"]
        self.swaths = self._frequency()
        self.channels = self._channels()
        self.transmitter = self.swaths[f"tx{self.channels[0][0]}"]
        self.notes: list[str] = []

    def _frequency(self) -> Any:
        """Group of the requested frequency band."""
        names = [name for name in ("A", "B") if f"frequency{name}" in self.root["swaths"]]
        if not names:
            raise InputError("has no swaths/frequencyA or frequencyB; give a level 0B file")
        wanted = self.options.frequency or names[0]
        if wanted not in names:
            raise InputError(f"--frequency is {wanted}, but the file has {' and '.join(names)}; give one of these")
        return self.root["swaths"][f"frequency{wanted}"]

    def _channels(self) -> tuple[str, ...]:
        """Requested polarisations of one transmitter."""
        there = [
            transmit + receive
            for transmit in "HVLR" if f"tx{transmit}" in self.swaths
            for receive in "HVLR" if f"rx{receive}" in self.swaths[f"tx{transmit}"]
            and transmit + receive in self.swaths[f"tx{transmit}"][f"rx{receive}"]
        ]  # fmt: skip
        if not there:
            raise InputError("has no samples, as txH/rxH/HH would be; give a level 0B file")
        wanted = self.options.polarization
        if wanted is None:
            return tuple(each for each in there if each[0] == there[0][0])
        if wanted not in there:
            raise InputError(f"--polarization is {wanted}, but the file has {', '.join(there)}; give one of these")
        return (wanted,)

    def number(self, name: str) -> float:
        """Number from the transmitter's group."""
        return float(np.asarray(self.transmitter[name][()]).ravel()[0])

    def strip(self) -> RawStrip:
        time, seconds = self.transmitter["UTCtime"], self._seconds
        pulses = slice(*slice(*self.options.pulses).indices(time.shape[0]))
        epoch = epoch_of(seconds(time), "units of UTCtime")
        even, notes = even_pulses(time[pulses])
        even = even.of_file(np.arange(pulses.start, pulses.stop))
        self.notes += notes
        even = self._without_calibration(even)
        telemetry = self.root["lowRateTelemetry"]
        window, delay = self._window(even)
        described = _text(time.attrs["description"]) if "description" in time.attrs else ""
        tags: TimeTags = "transmit" if "transmi" in described.lower() else "middle"
        mission = self._said("missionId")
        samples = [self.transmitter[f"rx{each[1]}"][each].name for each in self.channels]
        shape = self.transmitter[f"rx{self.channels[0][1]}"][self.channels[0]].shape
        if shape != (time.shape[0], self.transmitter["slantRange"].shape[0]):
            raise InputError(f"samples are {shape}, but UTCtime and slantRange of other lengths; {REMEDY}")
        adjustment = self.number("rangeDelayAdjustment") if "rangeDelayAdjustment" in self.transmitter else 0.0
        if adjustment:
            self.notes.append(f"rangeDelayAdjustment is {adjustment:.6g} s, taken to be in slantRange already")
        if not self.options.range_delay:
            self.notes.append(
                "no delay of the instrument is taken out; the mission's level 1 products state it in their calibration "
                "(commonDelay, in m of range): --range-delay takes out 2 / c times it"
            )
        chirp, corrections = self._chirp(1 / self._step(delay)), tuple(self._correction(each) for each in self.channels)
        side = self._said("lookDirection").lower()
        if side not in ("left", "right"):
            raise InputError(f"lookDirection is {quoted(side)}; it must be left or right")
        later = (epoch - epoch_of(seconds(telemetry["orbit/time"]), "units of orbit/time")).total_seconds()
        return RawStrip(
            title=f"{mission} {', '.join(self.channels)}".strip(), format=f"NISAR RRSD {self._said('productVersion')}",
            collector=mission, epoch=epoch, even=even, tags=tags, orbit=self._orbit(telemetry["orbit"], later),
            antenna=self._antenna(telemetry, epoch), length=LENGTHS.get(mission.upper()), side=side, delay=delay,
            chirp_rate=chirp.rate, pulse_width=chirp.width, centre=chirp.centre,
            carrier=self.number("centerFrequency"), sampling_rate=1 / self._step(delay), polarizations=self.channels,
            read=_Samples(self.path, tuple(samples), window, corrections), notes=self.notes,
        )  # fmt: skip

    @staticmethod
    def _step(delay: FloatArray) -> float:
        """Time between samples, s."""
        return float(delay[-1] - delay[0]) / (delay.size - 1)

    def _chirp(self, sampling_rate: float) -> Chirp:
        """Chirp of the pulse from slope and duration; its centre from chirpWaveform, if present.

        A replica's first sample belongs to the slant range of a target whose echo begins with it. Where its parabola
        misses the slope's by more than BENT at its ends, the replica is what was sent.
        """
        rate, width = self.number("chirpSlope"), self.number("chirpDuration")
        chirp = Chirp(rate=rate, width=width, centre=width / 2)
        if "chirpWaveform" not in self.transmitter:
            return chirp
        found = fitted_chirp(np.asarray(self.transmitter["chirpWaveform"][()]).ravel(), sampling_rate)
        if found is None or not 0 < found.centre < found.width:
            self.notes.append("chirpWaveform is no linear chirp; chirpSlope and chirpDuration are taken")
            return chirp
        if np.pi * abs(found.rate - rate) * (width / 2) ** 2 > BENT or abs(found.width - width) * sampling_rate > 2:
            self.notes.append(
                f"chirpWaveform is a chirp of {found.rate:.6g} Hz/s over {1e6 * found.width:.4g} us, and is taken; "
                f"chirpSlope and chirpDuration say {rate:.6g} Hz/s over {1e6 * width:.4g} us"
            )
            chirp = found
        if abs(found.centre - chirp.width / 2) * sampling_rate > CENTRED:
            self.notes.append(
                f"by chirpWaveform the pulse's centre comes {1e6 * found.centre:.6g} us after its beginning, "
                f"{1e6 * (found.centre - chirp.width / 2):.3g} us off the middle of its duration"
            )
        return chirp._replace(centre=found.centre)

    def _correction(self, channel: str) -> ComplexArray | None:
        """Factors (n_pulse,) that give echoes a constant phase relative to transmission; None without such data."""
        group = self.transmitter[f"rx{channel[1]}"]
        if "basebandPhaseCorrection" not in group:
            return None
        factors = np.asarray(group["basebandPhaseCorrection"][()]).astype(np.complex64)
        if factors.shape != (group[channel].shape[0],) or not np.isfinite(factors).all() or not np.abs(factors).all():
            raise InputError(
                f"basebandPhaseCorrection of {channel} is {factors.shape} or holds zeros or no numbers; it must have a "
                f"factor for each of the {group[channel].shape[0]} pulses: {REMEDY}"
            )
        return factors

    def _said(self, name: str) -> str:
        return _text(self.identification[name][()]) if name in self.identification else ""

    @staticmethod
    def _seconds(times: Any) -> str:
        """Unit of times: "seconds since ..."."""
        if "units" not in times.attrs:
            raise InputError(f"{times.name} has no units, seconds since a date; {REMEDY}")
        return _text(times.attrs["units"])

    def _orbit(self, group: Any, later: float) -> Orbit:
        """Orbit states at times, s, relative to the pulses' epoch, which is `later` seconds after theirs."""
        return Orbit(
            time=group["time"][()].astype(float) - later, position=group["position"][()].astype(float),
            velocity=group["velocity"][()].astype(float),
        )  # fmt: skip

    def _antenna(self, telemetry: Any, epoch: Any) -> Antenna | None:
        """Azimuth axis: y of the antenna's frame, rotated to Earth-centred axes by quaternions (w, x, y, z)."""
        if "attitude" not in telemetry or "quaternions" not in telemetry["attitude"]:
            return None
        group = telemetry["attitude"]
        later = (epoch - epoch_of(self._seconds(group["time"]), "units of attitude/time")).total_seconds()
        q = group["quaternions"][()].astype(float)
        length = np.linalg.norm(q, axis=-1)
        if q.ndim != 2 or q.shape[1] != 4 or not np.isfinite(q).all() or (length < 1e-6).any():
            return None
        w, x, y, z = (q / length[:, None]).T
        axis = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
        return Antenna(time=group["time"][()].astype(float) - later, axis=axis)

    def _window(self, even: Even) -> tuple[slice, FloatArray]:
        """Samples to read, as a slice, and their delays from the beginning of transmission, s."""
        slant = self.transmitter["slantRange"][()].astype(float)
        count = int(self.number("numberOfSubSwaths")) if "numberOfSubSwaths" in self.transmitter else 0
        valid = [
            self.transmitter[name][_run(even)].astype(np.int64)
            for name in (f"validSamplesSubSwath{i + 1}" for i in range(count)) if name in self.transmitter
        ]  # fmt: skip
        window = slice(0, slant.size)
        if valid:
            window, note = common_window(
                np.minimum(valid[0][:, 0], slant.size), np.minimum(valid[-1][:, 1], slant.size), slant.size
            )
            self.notes += [note] if note else []
            held = sum(float(np.mean(np.clip(each[:, 1] - each[:, 0], 0, None))) for each in valid)
            if len(valid) > 1:
                share = 1 - held / (window.stop - window.start)
                self.notes.append(
                    f"{len(valid)} sub-swaths; {100 * share:.3g} % of the samples lie in gaps between them, when other "
                    "pulses are sent: ground whose echoes fall there is darker"
                )
        return window, 2 * slant[window] / SPEED_OF_LIGHT

    def _without_calibration(self, even: Even) -> Even:
        """Drop calibration pulses, if they hold no echo: some files mark echoes as calibration."""
        if "calType" not in self.transmitter:
            return even
        kinds = self.transmitter["calType"][_run(even)]
        marked = np.flatnonzero(kinds != ECHO)
        echoes = np.flatnonzero(kinds == ECHO)
        if not marked.size or not echoes.size:
            return even
        channel = self.channels[0]
        group = self.transmitter[f"rx{channel[1]}"]
        near = echoes[np.clip(np.searchsorted(echoes, marked), 0, echoes.size - 1)]
        level = _levels(group)

        def power(places: IntArray) -> FloatArray:
            rows = (_decoded(group[channel][pulse], level) for pulse in even.pulses[places])
            return np.array([float(np.mean(np.abs(row) ** 2)) for row in rows])

        lost = power(marked) < HALF * power(near)
        if not lost.any():
            return even
        n_left = even.pulses.size - int(np.count_nonzero(lost))
        refuse_few(n_left, even.pulses.size, "calibration pulses have no echo", "take others with --pulses")
        self.notes.append(
            f"{even.pulses.size - n_left} of {even.pulses.size} pulses for calibration only: missing in the store"
        )
        return even.without(marked[lost])


def _run(even: Even) -> slice:
    """Consecutive pulses of the file, as a slice."""
    return slice(int(even.pulses[0]), int(even.pulses[-1]) + 1)


def _levels(group: Any) -> NDArray[np.float32] | None:
    """Table that decodes block floating point; None if samples are stored as numbers."""
    if "BFPQLUT" not in group:
        return None
    levels = group["BFPQLUT"][()].astype(np.float32)
    return np.asarray(np.where(np.isfinite(levels), levels, 0), np.float32)


def _decoded(samples: NDArray[Any], levels: NDArray[np.float32] | None) -> ComplexArray:
    """Decode samples (...) to complex64; 0 where they are not finite."""
    if samples.dtype.names is None:
        out = samples.astype(np.complex64)
    else:
        out = np.empty(samples.shape, np.complex64)
        for part, name in ((out.real, "r"), (out.imag, "i")):
            values = samples[name]
            coded = levels is not None and np.issubdtype(values.dtype, np.integer)
            part[...] = levels[values] if coded else values  # type: ignore[index]
    out[~np.isfinite(out)] = 0
    return out


@dataclass(frozen=True)
class _Samples:
    """Reader of channels' samples, by the names of their arrays."""

    path: Readable
    names: tuple[str, ...]
    window: slice
    corrections: tuple[ComplexArray | None, ...]  # of channels, of all pulses in the file

    def __call__(self, channel: int, pulses: IntArray) -> ComplexArray:
        with opened(self.path) as file:
            samples = file[self.names[channel]]
            rows = samples[int(pulses[0]) : int(pulses[-1]) + 1, self.window]
            taken: BoolArray = np.isin(np.arange(pulses[0], pulses[-1] + 1), pulses)
            decoded = _decoded(rows[taken] if not taken.all() else rows, _levels(samples.parent))
        factors = self.corrections[channel]
        return decoded if factors is None else decoded * factors[pulses, None]


NISAR = StripReader(
    name="nisar",
    title="NISAR raw echo",
    summary="Convert raw echoes of NISAR (level 0B RRSD, HDF5) to a phase history on the ellipsoid.",
    example="NISAR_L0_RRSD.h5 --out strip.zarr",
    source=("SOURCE.h5", "File of level 0B."),
    kind=KIND,
    options=NisarOptions,
    begin=begin,
)
