"""Date-times of reports as moments."""

import re
from datetime import UTC, datetime, timedelta


def utc_moment(timestamp: str) -> datetime:
    """Turn a date-time of RFC 3339 into a moment in UTC, to the microsecond."""
    # Python knows no leap seconds.
    leap = re.match(r"(.{17})60", timestamp)
    text = f"{leap[1]}59{timestamp[19:]}" if leap else timestamp
    # Nor more than six digits of a second.
    text = re.sub(r"(\.[0-9]{6})[0-9]+", r"\1", text.upper())
    return datetime.fromisoformat(text).astimezone(UTC) + timedelta(seconds=1 if leap else 0)


def utc_milliseconds(timestamp: str) -> str:
    """Write a date-time of RFC 3339 in UTC with milliseconds."""
    return utc_moment(timestamp).isoformat(timespec="milliseconds").replace("+00:00", "Z")
