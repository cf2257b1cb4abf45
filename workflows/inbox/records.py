"""Types and format of what a sweep writes and passes on."""

from __future__ import annotations

from typing import Any

FORMAT = 1  # of records, status and log

Event = dict[str, Any]
Record = dict[str, Any]  # the event that settled a collection, with fingerprint and settings
Settings = dict[str, Any]  # arguments of `focus`, as JSON holds them
