"""The ground of a block: its maps, its relief, and the correction of focused blocks onto it."""
