"""Whether the samples follow the declared sign SGN, in words.

With the wrong sign an echo of the delay dTOA appears at -dTOA. Echoes lie in TOA1 .. TOA2; where that interval is not
centred at the SRP, a part of it is outside of its mirror image, and only one sign puts energy there
(`measurement.window`). A scene about the SRP is mirrored through its centre and says nothing, nor does the domain TOA,
whose delays do not depend on the sign.
"""

from __future__ import annotations

from blocksar.measurement.window import WindowEnergy

# Makers whose files were reported to declare +1 with samples that follow -1.
DOUBTED = ("capella",)


def describe_sign(energy: WindowEnergy | None, sign: int, collector: str, *, given: bool) -> str | None:
    """A sentence if the samples contradict `sign`, or it is declared by a maker who was wrong; else None.

    Parameters
    ----------
    energy : WindowEnergy or None
        In TOA1 .. TOA2 with `sign`; None if delays do not depend on it.
    sign : int
        As taken: `given` by the user, or declared by the file.
    """
    conjugated = energy.conjugated if energy is not None else None
    if energy is not None and conjugated:
        return (
            f"SGN {sign:+d} contradicts the samples: in the part of TOA1 .. TOA2 that only one sign fills, their power "
            f"is {-energy.gain:.3g} dB lower with SGN {sign:+d} than with SGN {-sign:+d}; ingest again with --sgn "
            f"{-sign:+d}"
        )
    if conjugated is None and not given and sign > 0 and any(maker in collector.lower() for maker in DOUBTED):
        return (
            f"SGN +1 is doubtful: files of {collector} were seen to declare it with samples that follow -1, which "
            "mirrors the scene through its centre; compare places, and ingest again with --sgn -1 if so"
        )
    return None
