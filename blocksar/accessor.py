"""The `sar` accessor of xarray datasets; importing this module registers it."""

from __future__ import annotations

from blocksar.products.dataset import SarAccessor

__all__ = ["SarAccessor"]
