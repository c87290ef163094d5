"""The hour as journals, results and records write it."""

from __future__ import annotations

from datetime import UTC, datetime


def now() -> str:
    """The time as ISO 8601 in UTC, to milliseconds."""
    return _written(datetime.now(UTC), "milliseconds")


def time_of_file(mtime_s: float) -> str:
    """The time of a file, in seconds since 1970, as ISO 8601 in UTC, to seconds."""
    return _written(datetime.fromtimestamp(mtime_s, tz=UTC), "seconds")


def time_in_a_name() -> str:
    """The time in UTC as names have it: digits that sort."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}"


def _written(time: datetime, to: str) -> str:
    return time.isoformat(timespec=to).replace("+00:00", "Z")
