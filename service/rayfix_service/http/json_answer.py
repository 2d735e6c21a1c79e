"""Answers in JSON, written by pydantic's serialiser: several times faster than the standard library's."""

from typing import Any

from pydantic_core import to_json
from starlette.responses import Response


class JsonAnswer(Response):
    """A JSON document of plain dicts, lists, texts and numbers; what is not finite becomes null, as JSON has none."""

    media_type = "application/json"

    def render(self, content: Any) -> bytes:
        """Write the document."""
        return to_json(content, inf_nan_mode="null")
