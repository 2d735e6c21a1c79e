"""Texts for problems of a document: the field, the value found, and the probable key."""

import difflib
import math
from collections.abc import Collection, Mapping

_MAX_SHOWN = 60  # characters of a value or a key that a message repeats

Path = tuple[str | int, ...]
"""Keys and indices from the document's root to a field, such as ``("measurements", 0, "azimuth_deg")``."""


def path_text(path: Path) -> str:
    """Format a path: ``measurements[0].azimuth_deg``."""
    text = ""
    for step in path:
        # Keys that are not plain names are quoted, which escapes control characters.
        plain = isinstance(step, str) and step.isidentifier() and len(step) <= _MAX_SHOWN
        text += f".{step}" if plain else f"[{step if isinstance(step, int) else repr(shortened(step))}]"
    return text.removeprefix(".")


def shown(value: object) -> str:
    """Describe a value of a document briefly, with JSON's names of types."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if isinstance(value, Mapping):
        return "an object"
    if isinstance(value, list | tuple):
        return f"an array of length {len(value)}"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "infinite"
    if isinstance(value, int) and abs(value) > 10**20:
        return "a number of more than 20 digits"  # repr fails beyond 4300
    if isinstance(value, str):
        return repr(shortened(value))
    if isinstance(value, int | float):
        return repr(value)
    return f"a Python {type(value).__name__}"


def unknown_key(name: str, known: Collection[str]) -> str:
    """Report an unknown key, with the most similar key or a list of all."""
    close = difflib.get_close_matches(shortened(name), known, n=1)
    remedy = f"did you mean {close[0]}?" if close else f"leave it out or use one of {', '.join(known)}"
    return f"is an unknown key; {remedy}"


def shortened(text: str) -> str:
    """Shorten a long text."""
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."
