"""The examples of docs/formats.md work as they stand."""

import json
import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from rayfix_service.adapters.formats import InputFormat, OutputFormat, parse, write
from rayfix_service.adapters.silabs import parse_silabs_angle
from rayfix_service.locator import Locator
from rayfix_tables.table import Table
from tests.support.checkout import ROOT

PAGE = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")


def blocks(kind: str) -> dict[str, str]:
    """Fenced blocks of the page that are an ``input=`` or an ``output=``."""
    return dict(re.findall(rf"^```\w+ {kind}=(\w+)\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL))


INPUTS, OUTPUTS = blocks("input"), blocks("output")


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    return Locator(Table.open(hall_table_path))


def test_every_format_has_an_example():
    assert set(INPUTS) == {"nrppa", "silabs", "ublox"}
    assert set(OUTPUTS) == {"3gpp", "omlox"}


@pytest.mark.parametrize("name", INPUTS)
def test_an_input_is_located(name: str, locator: Locator):
    (adapted,) = parse(INPUTS[name].encode(), cast("InputFormat", name))
    fix = locator.locate(adapted.report)
    assert fix.status == "ok"
    assert all(outcome.used for outcome in fix.outcomes)
    assert adapted.skipped == ()
    # Their noise is one of about a degree at up to 9 m, or with u-blox half a degree of rounding.
    place = np.array([7.0, 4.0, 1.5])
    if name == "ublox":  # the wide errors that are assumed of its anchors reach beyond the walls, which pulls the mean
        assert fix.regions is not None
        assert fix.regions.ellipsoid(0.68).holds(place)
    else:
        assert fix.position == pytest.approx(place, abs=0.5)
    assert fix.candidates[0].probability > 0.7


def test_the_payload_for_a_broker_is_an_angle():
    (payload,) = re.findall(r"mosquitto_pub -t \S+ -m '(.*?)'", PAGE, flags=re.DOTALL)
    assert parse_silabs_angle(payload.encode()).sequence == 4711


def shape_of(document: Any) -> Any:
    """Names and types of a document, numbers being alike."""
    if isinstance(document, dict):
        return {key: shape_of(value) for key, value in document.items()}
    if isinstance(document, list):
        return [shape_of(value) for value in document]
    return float if isinstance(document, int | float) else type(document)


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_output_is_of_that_shape(name: str, locator: Locator):
    (adapted,) = parse(INPUTS["nrppa"].encode(), "nrppa")
    fix = locator.locate(adapted.report)
    written = write(fix, cast("OutputFormat", name), locator.table.site, compute_seconds=0.0)
    assert shape_of(written) == shape_of(json.loads(OUTPUTS[name]))
