"""Figures with several panels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from blocksar.products.pictures import panels


def test_panels_share_one_scale_and_one_legend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Any] = []
    monkeypatch.setattr(panels, "save", lambda figure, path: kept.append(figure))
    edges, x = np.arange(5.0), np.linspace(0, 4, 9)
    maps = [panels.Map(np.full((4, 4), value), edges, edges, value - 30, value) for value in (0.0, -20.0)]
    drawn = [
        panels.Panel(
            "map", "s", "Hz", [panels.Trace("line", x, x, "red", style)], [panels.LimitLine("limit", 2.0)], shown
        )
        for shown, style in zip(maps, ("--", "."), strict=True)
    ]
    panels.plot_panels(drawn, tmp_path / "panels.png", bar="power (dB)")
    figure = kept[0]
    assert [mesh.get_clim() for axes in figure.axes[:2] for mesh in axes.collections] == [(-50.0, 0.0)] * 2
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["line", "limit"]
