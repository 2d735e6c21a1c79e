"""Whatever comes, there is a report or a refusal that names the culprit, and never a crash."""

import copy
import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_service.adapters.adapted import Adapted
from rayfix_service.adapters.nrppa import parse_nrppa
from rayfix_service.adapters.silabs import parse_silabs, parse_silabs_angle
from rayfix_service.adapters.silabs_stream import SilabsStream
from rayfix_service.adapters.ublox import parse_ublox
from rayfix_service.http.openapi.examples import NRPPA_EXAMPLES, SILABS_EXAMPLES, UBLOX_EXAMPLES
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_service.wire import path_text, problems_of
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station

NRPPA = [example["value"] for example in NRPPA_EXAMPLES.values()]
SILABS = [example["value"] for example in SILABS_EXAMPLES.values()]
LINES: str = UBLOX_EXAMPLES["three_anchors"]["value"]

SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
JSON = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
)


def places(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all values within a document."""
    if isinstance(document, dict):
        steps: Any = document.items()
    elif isinstance(document, list):
        steps = enumerate(document)
    else:
        steps = ()
    return [path, *(place for step, value in steps for place in places(value, (*path, step)))]


@st.composite
def spoiled(draw: st.DrawFn, originals: list[Any]) -> Any:
    """Draw a document with one value replaced, removed, or misnamed."""
    document = copy.deepcopy(draw(st.sampled_from(originals)))
    path = draw(st.sampled_from(places(document)))
    if not path:
        return draw(JSON)
    at = document
    for step in path[:-1]:
        at = at[step]
    change = draw(st.sampled_from(["replace", "remove", "misname"]))
    if change == "replace":
        at[path[-1]] = draw(JSON)
    else:
        value = at.pop(path[-1])
        if change == "misname" and isinstance(at, dict):
            at[draw(st.text(max_size=5))] = value
    return document


def take(parse: Callable[[bytes], Any], body: bytes) -> None:
    """Expect a report or a proper refusal."""
    try:
        taken = parse(body)
    except ReportError as error:
        for problem in problems_of(error):
            assert problem.message
            assert "\n" not in problem.message
            assert len(problem.message) < 2000
            assert problem.path == () or path_text(problem.path)
    else:
        for adapted in taken if isinstance(taken, tuple) else (taken,):
            if isinstance(adapted, Adapted):
                assert len(adapted.sources) == len(adapted.report.measurements) > 0


@settings(deadline=None, max_examples=300)
@given(spoiled(NRPPA))
def test_nrppa(document: Any):
    take(parse_nrppa, json.dumps(document).encode())


@settings(deadline=None, max_examples=300)
@given(spoiled(SILABS))
def test_silabs(document: Any):
    take(parse_silabs, json.dumps(document).encode())


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["a/ble-1/tag", "a/bs1/tag", "bs2/tag", "a/bs1/", "/", "", "x", "a/bs2/t\N{SNOWMAN}g/+"])
            | st.text(max_size=8),
            st.binary(max_size=8)
            | spoiled([{key: value for key, value in SILABS[0]["angles"][0].items() if key != "locator_id"}]).map(
                lambda value: json.dumps(value).encode()
            ),
            st.floats(-1.0, 3.0),
        ),
        max_size=12,
    )
)
def test_a_stream_of_messages(messages: list[tuple[str, bytes, float]]):
    """Whatever topics, payloads and clocks a broker comes with, what comes out is of known stations."""
    stations = tuple(
        Station(id=name, position=(0.0, 0.0, 2.0), orientation=(0.0, 0.0, 0.0), field_of_view=6.3)
        for name in ("bs1", "bs2")
    )
    site = SiteInfo(name="hall", north=0.0, max_path_length=60.0, stations=stations, document={})
    stream = SilabsStream(site, window=0.5, stations={"ble-1": "bs1"})
    now, reports = 0.0, []
    for topic, payload, step in messages:
        now += step
        reports += stream.receive(topic, payload, now)
    reports += stream.due(now + 1.0)
    for adapted in reports:
        heard = [measurement.station_id for measurement in adapted.report.measurements]
        assert set(heard) <= {"bs1", "bs2"}
        assert adapted.report.target_id
    assert stream.due(now + 1.0) == []


@given(st.datetimes(datetime(1, 1, 3), datetime(9999, 12, 29)), st.integers(-1439, 1439), st.integers(0, 9))
def test_date_times_are_moments(moment: datetime, offset: int, digits: int):
    """A date-time of RFC 3339 is the moment that it was made from, to the digits that it has, at most six."""
    sign = "-" if offset < 0 else "+"
    second = f"{moment.microsecond:06d}000"[:digits]
    text = f"{moment.replace(microsecond=0).isoformat()}{'.' if digits else ''}{second}"
    text += f"{sign}{abs(offset) // 60:02d}:{abs(offset) % 60:02d}"
    expected = moment.replace(microsecond=int(second[:6].ljust(6, "0")), tzinfo=UTC) - timedelta(minutes=offset)
    assert utc_moment(text) == expected


@pytest.mark.parametrize(
    ("text", "year"),
    [("0001-01-01T00:00:00+23:59", 1), ("9999-12-31T23:59:60Z", 9999), ("9999-12-31T23:59:59-01:00", 9999)],
)
def test_moments_beyond_all_years_are_the_last(text: str, year: int):
    assert utc_moment(text).year == year


@settings(deadline=None)
@given(st.binary(max_size=50) | JSON.map(lambda value: json.dumps(value).encode()))
def test_bytes(body: bytes):
    for parse in (parse_nrppa, parse_silabs, parse_silabs_angle, parse_ublox):
        take(parse, body)


@settings(deadline=None, max_examples=300)
@given(st.data())
def test_ublox(data: st.DataObject):
    position = data.draw(st.integers(0, len(LINES)))
    length = data.draw(st.integers(0, 10))
    instead = data.draw(st.text(max_size=5))
    take(parse_ublox, (LINES[:position] + instead + LINES[position + length :]).encode())


@pytest.mark.parametrize(
    "line",
    [
        "+UUDF:",
        '+UUDF:"',
        "+UUDF:\0",
        "+UUDF:a\rb",
        '+UUDF:t,1,1,1,1,1,"a","unfinished,1',
        "+UUDF:t,1_0,1,1,1,1,a,,1",
        "+UUDF:t,\u0661,1,1,1,1,a,,1",
        "+UUDF:" + "9" * 200_000,
    ],
)
def test_odd_lines_are_refused(line: str):
    with pytest.raises(ReportError):
        parse_ublox(line)
