"""GPS time, which packets have, and UTC."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

GPS = datetime(1980, 1, 6, tzinfo=UTC)
# Seconds that GPS time is ahead of UTC, from a GPS second on.
LEAPS = ((0, 16), (1119744017, 17), (1167264018, 18))


def utc(zero: int, seconds: float) -> str:
    """UTC of so many seconds after a GPS second, ISO 8601."""
    ahead = next(leap for since, leap in reversed(LEAPS) if zero >= since)
    moment: datetime = GPS + timedelta(seconds=zero - ahead) + timedelta(seconds=seconds)
    return f"{moment.replace(tzinfo=None).isoformat(timespec='microseconds')}Z"
