"""The parts of `workflows/reproduce_papers.py`."""
