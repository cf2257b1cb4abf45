"""`python -m blocksar` is `blocksar`."""

from __future__ import annotations

from blocksar.cli.commands import main

main()
