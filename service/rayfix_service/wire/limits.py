"""How much of a document is looked at: limits that are checked before the validation, which costs much more."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, get_args

from pydantic import BaseModel


@dataclass(frozen=True, kw_only=True)
class MessageLimits:
    """What a message may hold, counted before the rest of it is looked at, and what is said of one that is refused.

    Attributes
    ----------
    report_values : int
        Values of the JSON text of a report, keys and elements counted; one of 256 full measurements has 3300.
    message_values : int
        Values of the JSON text of a message of another format, those that are not read counted.
    results : int
        Measurements of an NRPPa message, all TRPs together, each angle of a MultipleULAoA counted; with the ranges that
        ``ue_rx_tx`` makes of them, twice as many.
    stations : int
        Names in the map of stations of a message.
    batch_rest_bytes : int
        Bytes of a batch beside its reports.
    listed_problems : int
        Offending fields that a problem lists, those of a batch together; the others are counted.
    """

    report_values: int = 5000
    message_values: int = 50_000
    results: int = 1024
    stations: int = 1024
    batch_rest_bytes: int = 64 << 10
    listed_problems: int = 50


USUAL_LIMITS = MessageLimits()
"""Those of who sets none."""

MAX_DEPTH = 200
"""Levels of a JSON text; its parser ends at the next."""

TOKEN = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+"?+|[,\[\]{}]', re.DOTALL)
"""A string, whole so that nothing within it counts, or what shapes a document."""

_DEEPEST = 16
"""Levels of a document that has all its objects where they belong."""


def has_more_values(text: bytes, most: int) -> bool:
    """Check whether a JSON text has more than so many values; the work is bounded by that number.

    An object of n keys and an array of n elements count as n values each, or as 1 when they are empty. What comes after
    too deep a nesting, where the parser ends, does not count.
    """
    if text.count(b",") + text.count(b"[") + text.count(b"{") <= most:
        return False  # commas in strings do not make it fewer
    num_values = depth = 0
    for token in TOKEN.finditer(text):
        mark = text[token.start()]
        depth += (mark in b"[{") - (mark in b"]}")
        if depth > MAX_DEPTH:
            return False
        num_values += mark in b",[{"
        if num_values > most:
            return True
    return False


@cache
def names_of(model: type[BaseModel]) -> frozenset[str]:
    """Return the names of all fields of a model and of the models within it, as they stand in documents."""
    names: set[str] = set()
    for name, field in model.model_fields.items():
        names.add(field.alias or name)
        for inner in models_within(field.annotation):
            names |= names_of(inner)
    return frozenset(names)


def models_within(annotation: Any) -> tuple[type[BaseModel], ...]:
    """Return the models that an annotation names, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return (annotation,)
    return tuple(model for inner in get_args(annotation) for model in models_within(inner))


def trimmed(document: object, known: frozenset[str], spare: int) -> Any:
    """Copy a document without its unknown keys, but for the first so many; what they hold is left out."""
    return _trim(document, known, [spare], _DEEPEST)


def _trim(value: Any, known: frozenset[str], spare: list[int], depth: int) -> Any:
    if depth == 0:
        return value
    if isinstance(value, list | tuple):
        return [_trim(element, known, spare, depth - 1) for element in value]
    if not isinstance(value, Mapping):
        return value
    kept = {}
    for key, inner in value.items():
        if key in known:
            kept[key] = _trim(inner, known, spare, depth - 1)
        elif spare[0] > 0:
            spare[0] -= 1
            kept[key] = inner
    return kept
