"""Types and format of what a sweep writes and passes on."""

from __future__ import annotations

from typing import Any

FORMAT = 1  # of records, status and log

Event = dict[str, Any]
# The event that settled a collection, with fingerprint and settings; `told`: the hook has received it, `said`: a sweep
# has exited with status 3 since.
Record = dict[str, Any]
Settings = dict[str, Any]  # arguments of `focus`, as JSON holds them
