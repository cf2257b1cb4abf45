"""The parts of `workflows/process_inbox.py`."""
