"""Log formats: text or JSON, one record per line."""

import copy
import json
import logging
import re
from datetime import UTC, datetime
from typing import Any, Literal

import uvicorn.config
from uvicorn.logging import DefaultFormatter

from rayfix_service.http.telemetry.request_context import ACCESS_LOGGER, REQUEST_ID

LogFormat = Literal["text", "json"]

_TEXT = "%(asctime)s %(levelprefix)s %(message)s"

# Control characters, which include terminal escape sequences, line separators and bidirectional controls.
_UNFIT = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def on_one_line(text: str) -> str:
    """Replace characters that could forge or break a log line by Python escapes."""
    return _UNFIT.sub(lambda match: ascii(match[0])[1:-1], text)


def utc_time(record: logging.LogRecord) -> str:
    """Write the time of a record as UTC with milliseconds, such as ``2026-01-31T10:00:00.250Z``."""
    time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
    return time.replace("+00:00", "Z")


class TextFormatter(DefaultFormatter):
    """Writes a record as uvicorn does, its time in UTC, its message on one line whatever a client had it contain."""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:  # noqa: N802
        """Write the time of a record."""
        return utc_time(record)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """Write one record, without the traceback."""
        record.message = on_one_line(record.message)
        return super().formatMessage(record)


class JsonFormatter(logging.Formatter):
    """Formats a record as one line of JSON.

    Keys are ``time`` (UTC), ``level``, ``logger`` and ``message``; ``request_id`` within a request; ``exception`` with
    the traceback; and the keys of the record's ``fields``.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Write one record."""
        entry: dict[str, Any] = {
            "time": utc_time(record),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if (identifier := REQUEST_ID.get()) is not None:
            entry["request_id"] = identifier
        entry.update(getattr(record, "fields", {}))
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


def log_config(log_format: LogFormat, *, access_log: bool) -> dict[str, Any]:
    """Extend uvicorn's logging to the messages of this package, for :func:`logging.config.dictConfig`.

    Parameters
    ----------
    log_format : {"text", "json"}
    access_log : bool
        Whether to log a line per request.
    """
    config = copy.deepcopy(uvicorn.config.LOGGING_CONFIG)
    if log_format == "json":
        config["formatters"] = {name: {"()": _name_of(JsonFormatter)} for name in config["formatters"]}
    else:
        config["formatters"]["default"] |= {"()": _name_of(TextFormatter), "fmt": _TEXT}
    for name in ("rayfix", "rayfix_service"):
        config["loggers"][name] = {"handlers": ["default"], "level": "INFO", "propagate": False}
    config["loggers"][ACCESS_LOGGER] = {"level": "INFO" if access_log else "WARNING"}
    return config


def _name_of(formatter: type[logging.Formatter]) -> str:
    return f"{formatter.__module__}.{formatter.__qualname__}"
