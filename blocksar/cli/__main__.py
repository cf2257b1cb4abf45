"""Run the command line as `python -m blocksar.cli`."""

from __future__ import annotations

from blocksar.cli import main

main()
