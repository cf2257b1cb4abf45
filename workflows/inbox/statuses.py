"""Exit statuses of a sweep; those of interrupted sweeps are in `blocksar.cli.endings`."""

from __future__ import annotations

import os

DONE = 0
FAILED = 1  # worth another try
USAGE = 2
QUARANTINED = 3
BUSY = os.EX_TEMPFAIL  # 75: another sweep holds the outbox
