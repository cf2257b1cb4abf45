"""The files of packets that a user gives, or that lie in a SAFE folder, and the bursts in them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from blocksar.errors import InputError
from blocksar.ingestion.found import refuse_others
from blocksar.ingestion.reading import reading
from blocksar.ingestion.sentinel1.bursts import Burst, find_bursts, polarizations
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
        """That of its echoes, the first one's.

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


def chosen(files: Sequence[File], options: Sentinel1Options) -> tuple[list[tuple[File, list[Burst]]], int, list[str]]:
    """The bursts that are wanted of each file, the GPS second from which their times count, and notes.

    Raises
    ------
    InputError
        If there are none.
    """
    notes: list[str] = []
    have = {file.polarization: None for file in files}
    like = [each for each in have if each[0] == each[1]]
    wanted = options.polarization or (like or list(have))[0]
    if wanted not in have:
        raise InputError(f"--polarization is {wanted}, but the packets have {', '.join(have)}; give one of these")
    if len(have) > 1 and options.polarization is None:
        notes.append(f"of polarisations {', '.join(have)}, {wanted} is taken; others with --polarization")
    of_it = [file for file in files if file.polarization == wanted]
    zero = min(int(file.packets.seconds.min()) for file in of_it)
    found: list[tuple[File, list[Burst]]] = []
    swaths: dict[str, int] = {}
    for file in of_it:
        bursts, said = find_bursts(file.packets, zero)
        notes += said
        for burst in bursts:
            swaths[burst.swath] = max(swaths.get(burst.swath, 0), burst.number + 1)
        first, last = options.bursts
        kept = [
            burst for burst in bursts
            if options.swath in (None, burst.swath) and first <= burst.number < (burst.number + 1 if last is None else last)
        ]  # fmt: skip
        found.append((file, kept))
    if not any(kept for _, kept in found):
        held = ", ".join(f"{number} of {swath}" for swath, number in swaths.items()) or "none"
        raise InputError(f"no burst is left by --swath and --bursts; the packets have {held}, counted from 0")
    return found, zero, notes
