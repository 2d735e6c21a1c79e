"""Timestamps of reports."""

import re
from datetime import UTC, datetime, timedelta


def utc_moment(timestamp: str) -> datetime:
    """Convert an RFC 3339 date-time into a datetime in UTC, to the microsecond.

    A time that lies before the year 1 or after 9999 in UTC becomes the earliest or latest datetime.
    """
    # Python has no leap seconds.
    leap = re.match(r"(.{17})60", timestamp)
    text = f"{leap[1]}59{timestamp[19:]}" if leap else timestamp
    # It accepts at most six digits of a second.
    text = re.sub(r"(\.[0-9]{6})[0-9]+", r"\1", text.upper())
    moment = datetime.fromisoformat(text)
    try:
        return moment.astimezone(UTC) + timedelta(seconds=1 if leap else 0)
    except OverflowError:
        return (datetime.min if moment.year == 1 else datetime.max).replace(tzinfo=UTC)


def utc_milliseconds(timestamp: str) -> str:
    """Format a datetime as RFC 3339, in UTC with milliseconds."""
    return utc_moment(timestamp).isoformat(timespec="milliseconds").replace("+00:00", "Z")
