"""The parts of `workflows/benchmark.py`."""
