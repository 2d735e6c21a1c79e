"""The tree of errors."""

import re

import pytest

from rayfix_tables import errors
from rayfix_tables.errors import RayfixError, ReportError


def test_all_names_every_error() -> None:
    defined = {name for name, value in vars(errors).items() if isinstance(value, type)}
    assert set(errors.__all__) == defined


def test_the_drawn_tree_is_the_real_one() -> None:
    """Each line of the docstring's tree is indented by four columns below its parent."""
    assert errors.__doc__ is not None
    drawn = []
    for line in errors.__doc__.splitlines():
        match = re.match(r"    (?P<branch>[│├└─ ]*)(?P<name>\w+Error)\b", line)
        if match:
            drawn.append((len(match["branch"]) // 4, match["name"]))
    parents: list[str] = []
    for depth, name in drawn:
        parents = [*parents[:depth], name]
        base = getattr(errors, name).__base__
        assert base.__name__ == (parents[depth - 1] if depth else "Exception")
    assert sorted(name for _, name in drawn) == sorted(errors.__all__)


def test_a_report_error_names_its_field() -> None:
    with pytest.raises(RayfixError, match="out of range") as caught:
        raise ReportError("azimuth out of range", path=("measurements", 0, "azimuth_deg"))
    assert isinstance(caught.value, ReportError)
    assert caught.value.path == ("measurements", 0, "azimuth_deg")
    assert ReportError("no path").path == ()
