"""The rule by which a station selects what it reports, as a text of the table file."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, get_args

from rayfix_tables.site import Rule, Selection

SELECTION = "selection"
"""Attribute of a station's group; a station whose rule is the table's has none."""


def selection_text(selection: Selection) -> str:
    """Write a rule."""
    return json.dumps(asdict(selection), sort_keys=True)


def read_selection(attributes: Mapping[str, Any]) -> Selection | None:
    """Read the rule of a station from the attributes of its group, None where there is none.

    Raises
    ------
    ValueError
        When it is damaged.
    """
    text = attributes.get(SELECTION)
    if text is None:
        return None
    try:
        document = json.loads(text)
        rule, exponent, within = document["rule"], document["exponent"], document["within_db"]
        numbers = [exponent] if within is None else [exponent, within]
        if rule not in get_args(Rule) or not all(
            isinstance(number, int | float) and math.isfinite(number) and number >= 0.0 for number in numbers
        ):
            raise ValueError("the selection rule of a station is none")
        return Selection(rule=rule, exponent=float(exponent), within_db=None if within is None else float(within))
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError("the selection rule of a station is damaged") from error
