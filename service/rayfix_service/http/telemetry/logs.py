"""Logs as JSON, one object a line."""

import copy
import json
import logging
from datetime import UTC, datetime
from typing import Any, Literal

import uvicorn.config

from rayfix_service.http.telemetry.request_context import ACCESS_LOGGER, REQUEST_ID

LogFormat = Literal["text", "json"]


class JsonFormatter(logging.Formatter):
    """Writes a record as one line of JSON.

    Keys are ``time`` (UTC), ``level``, ``logger``, ``message``, within a request ``request_id``, of an exception
    ``exception``, and what the record has in ``fields``.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Write one record."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        entry: dict[str, Any] = {
            "time": time.replace("+00:00", "Z"),
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
        config["formatters"] = {
            name: {"()": f"{JsonFormatter.__module__}.{JsonFormatter.__qualname__}"} for name in config["formatters"]
        }
    config["loggers"]["rayfix_service"] = {"handlers": ["default"], "level": "INFO", "propagate": False}
    config["loggers"][ACCESS_LOGGER] = {"level": "INFO" if access_log else "WARNING"}
    return config
