"""Server-sent events (WHATWG HTML, 9.2), line by line."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ServerEvent:
    """One event."""

    name: str
    data: str


class EventReader:
    """Assembles events from lines."""

    def __init__(self) -> None:
        self._name = ""
        self._data: list[str] = []

    def take(self, line: str) -> ServerEvent | None:
        """Take a line without its line break and return the event that it completes, if any."""
        if not line:
            event = ServerEvent(name=self._name or "message", data="\n".join(self._data)) if self._data else None
            self._name, self._data = "", []
            return event
        if line.startswith(":"):
            return None
        field, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if field == "event":
            self._name = value
        elif field == "data":
            self._data.append(value)
        return None
