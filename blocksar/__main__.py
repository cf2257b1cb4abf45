"""`python -m blocksar` is `blocksar`."""

from blocksar.cli import main

main()
