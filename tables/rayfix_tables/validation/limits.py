"""Ranges of settings, stated in their type annotations and checked by one function.

>>> @dataclass(frozen=True, kw_only=True)
... class Settings:
...     probability: Annotated[float, Limits(above=0.0, below=1.0)] = 0.01
...
...     def __post_init__(self) -> None:
...         check_limits(self)
"""

import math
import numbers
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from rayfix_tables.errors import SettingsError


@dataclass(frozen=True, kw_only=True)
class Limits:
    """The range of a number. Infinity and NaN are never within it.

    Attributes
    ----------
    least, above : float, optional
        The number is at least ``least``, or greater than ``above``.
    below : float, optional
        The number is less than this.
    most : float, optional
        The number is at most this one.
    """

    least: float | None = None
    above: float | None = None
    below: float | None = None
    most: float | None = None

    def hold(self, value: float) -> bool:
        """Whether a number is within the range."""
        return (
            math.isfinite(value)
            and (self.least is None or value >= self.least)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
            and (self.most is None or value <= self.most)
        )

    def __str__(self) -> str:
        """Describe the range, such as "above 0 and below 1"."""
        words = {"at least": self.least, "above": self.above, "below": self.below, "at most": self.most}
        return " and ".join(f"{word} {limit:g}" for word, limit in words.items() if limit is not None)


def check_limits(settings: Any) -> None:
    """Check the fields of a dataclass whose types are annotated with :class:`Limits`.

    Parameters
    ----------
    settings : dataclass

    Raises
    ------
    SettingsError
        When a field is not a number of its type, or out of its range.
    """
    for name, kind, limits in _limited_fields(settings.__class__):
        value: Any = getattr(settings, name)
        wanted, noun = (numbers.Integral, "a whole number") if kind is int else (numbers.Real, "a finite number")
        is_number = isinstance(value, wanted) and not isinstance(value, bool)
        if not is_number or not limits.hold(value):
            raise SettingsError(f"{type(settings).__name__}: {name} is {value!r}; give {noun} {limits}".rstrip())


@cache
def _limited_fields(kind: type) -> tuple[tuple[str, type, Limits], ...]:
    """Name, type and range of each field that has a range."""
    found = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is Annotated:
            base, *notes = get_args(hint)
            found += [(name, base, note) for note in notes if isinstance(note, Limits)]
    return tuple(found)
