"""Headers of a request as the server gives them: pairs of bytes, the names in lower case."""

from collections.abc import MutableMapping
from typing import Any


def header(scope: MutableMapping[str, Any], name: bytes) -> str | None:
    """Return the first header of a name; Starlette's object of all headers takes longer to make than this.

    Parameters
    ----------
    scope : mapping
        Of an ASGI connection.
    name : bytes
        In lower case.
    """
    for each, value in scope["headers"]:
        if each == name:
            text: str = value.decode("latin-1")
            return text
    return None
