"""The `sar` accessor of xarray's datasets, arrays and trees; importing this module registers it."""

from __future__ import annotations

from blocksar.products.dataset import SarAccessor

__all__ = ["SarAccessor"]
