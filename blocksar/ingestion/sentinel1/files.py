"""The files of packets that a user gives, or that lie in a SAFE folder, and the bursts in them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from blocksar.errors import InputError
from blocksar.ingestion.found import refuse_others
from blocksar.ingestion.reading import reading
from blocksar.ingestion.sentinel1.bursts import LEAST, Burst, find_bursts, polarizations
from blocksar.ingestion.sentinel1.options import Sentinel1Options
from blocksar.ingestion.sentinel1.packets import KIND, Packets, read_headers
from blocksar.places import Location, readable
from blocksar.places.local import LocalPlace
from blocksar.places.ranges import Readable

DAMAGED, REMEDY = "damaged", "get it again"
BESIDE = re.compile(r"-(annot|index)\.dat$")  # what lies beside packets in a SAFE folder


class File(NamedTuple):
    """A file of packets, and their headers."""

    where: Readable
    packets: Packets

    @property
    def polarization(self) -> str:
        """Polarization of its echoes, the first one's.

        Raises
        ------
        InputError
            If it has none.
        """
        echoes = self.packets[self.packets.echo]
        if not len(echoes):
            raise InputError(f"{self.where} holds {len(self.packets)} packets of noise or calibration and no echo")
        return polarizations(echoes[:1])[0]


def expand(sources: Sequence[Location]) -> list[Readable]:
    """The files of packets among these, and in folders among them.

    Raises
    ------
    InputError
        If there are none.
    """
    found: list[Readable] = []
    for source in sources:
        where = readable(source)
        if isinstance(where, LocalPlace) and where.path.is_dir():
            inside = [where / name for name in sorted(where.names()) if name.endswith(".dat")]
            found += (inside := [each for each in inside if not BESIDE.search(each.name)])
            if not inside:
                refuse_others(where, KIND)
                raise InputError(f"{where} holds no .dat file of packets; give a SAFE folder of level 0")
        elif not BESIDE.search(where.name):
            found.append(where)
    if not found:
        raise InputError("no file of packets is given; give the .dat file, not its annotation or index")
    return found


def open_files(sources: Sequence[Location]) -> list[File]:
    """Read the headers of all files.

    Raises
    ------
    InputError
        If one is of another kind, cut or damaged.
    """
    files = []
    for where in expand(sources):
        with reading(where, damaged=DAMAGED, remedy=REMEDY):
            refuse_others(where, KIND)
            with where.open() as file:
                files.append(File(where, read_headers(file)))
    return files


class Choice(NamedTuple):
    """Bursts of one polarisation: all in the order of time with their files, and which of them are wanted."""

    bursts: list[tuple[File, Burst]]
    wanted: list[bool]
    packets: Packets
    zero: int
    notes: list[str]


def choose(files: Sequence[File], options: Sentinel1Options) -> Choice:
    """The bursts of files, of which one polarisation is wanted, and notes.

    Raises
    ------
    InputError
        If none is left.
    """
    have = list(dict.fromkeys(file.polarization for file in files))
    like = [each for each in have if each[0] == each[1]]
    polarization = options.polarization or (like or have)[0]
    if polarization not in have:
        raise InputError(f"--polarization is {polarization}, but the packets have {', '.join(have)}; give one of these")
    notes = []
    if len(have) > 1 and options.polarization is None:
        notes.append(f"of polarisations {', '.join(have)}, {polarization} is taken; others with --polarization")
    of_it = [file for file in files if file.polarization == polarization]
    zero = min(int(file.packets.seconds.min()) for file in of_it)
    found: list[tuple[File, Burst]] = []
    for file in of_it:
        bursts, said = find_bursts(file.packets, zero)
        found += [(file, burst) for burst in bursts]
        notes += said
    found.sort(key=lambda each: each[1].sent)
    counts: dict[str, int] = {}
    numbered = []
    for file, burst in found:
        number = counts.get(burst.swath, 0)
        counts[burst.swath] = number + 1
        numbered.append((file, replace(burst, number=number)))
    first, last = options.bursts
    wanted = [
        options.swath in (None, burst.swath) and first <= burst.number and (last is None or burst.number < last)
        for _, burst in numbered
    ]
    if not counts:
        raise InputError(f"the packets hold no burst of {LEAST} pulses or more; give a longer part of the data")
    if not any(wanted):
        held = ", ".join(f"{number} of {swath}" for swath, number in counts.items())
        raise InputError(f"no burst is left by --swath and --bursts; the packets have {held}, counted from 0")
    return Choice(numbered, wanted, Packets.joined([file.packets for file in of_it]), zero, notes)
