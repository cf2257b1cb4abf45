"""The plan of a chain: blocks, fits, search, prediction."""
