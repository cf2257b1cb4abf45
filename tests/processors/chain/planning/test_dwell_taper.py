"""Windows for halves of dwells of different lengths."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.collection.weighting import Weighting
from blocksar.processors.chain.planning.gating import plan_taper
from blocksar.processors.chain.steps.lines import RowPolynomial

ANY = RowPolynomial(series=np.ones((1, 1)), near=0.0, far=1.0, centre=0.0, scale=1.0)


@pytest.mark.parametrize("longest", [0.45, 1.7])
def test_dwells_that_the_collection_cuts_leave_full_ones_their_windows(longest: float) -> None:
    """Four windows up to 1.7 s gave dwells of 0.3 to 0.42 s weights that were off by 0.1."""
    taper = Weighting.parse("taylor:4:-35").azimuth
    lengths = np.concatenate([np.linspace(0.3, 0.42, 9), np.linspace(0.43, longest, 9)])[None]
    planned = plan_taper(taper, (lengths, lengths), (ANY, ANY), full=lengths <= 0.42).begin
    full = lengths[0, :9, None]
    since = full * np.linspace(0.02, 1.2, 60)
    wanted = taper(np.maximum(1 - since / full, 0.0)) / taper(np.array(0.0))
    assert np.abs(planned.blended(taper, since, full) - wanted).max() < 8e-3
