"""Other systems' formats over HTTP: inputs and outputs combine freely, and refusals name the field of the message."""

import copy
from typing import Any

import httpx
import pytest

from rayfix_service.http.openapi.examples import BATCH_EXAMPLES, NRPPA_EXAMPLES, SILABS_EXAMPLES, UBLOX_EXAMPLES
from rayfix_service.http.openapi.responses import AdaptedFixDocument, Local3dPointUncertaintyEllipsoid, OmloxLocation
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp

NRPPA = NRPPA_EXAMPLES["ul_aoa_and_ul_rtoa"]["value"]
SILABS = SILABS_EXAMPLES["three_locators"]["value"]
LINES: str = UBLOX_EXAMPLES["three_anchors"]["value"]
MODELS = {"3gpp": Local3dPointUncertaintyEllipsoid, "omlox": OmloxLocation}


def post(app: RunningApp, path: str, body: Any) -> httpx.Response:
    """POST JSON, or a text as plain text."""
    if isinstance(body, str):
        return app.post_bytes(path, body, {"content-type": "text/plain; charset=utf-8"})
    return app.post(path, body)


@pytest.mark.parametrize("output", ["3gpp", "omlox"])
@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/v1/positions", REPORT),
        ("/v1/positions/batch", BATCH_EXAMPLES["two_reports"]["value"]),
        ("/v1/positions/nrppa", NRPPA),
        ("/v1/positions/silabs", SILABS),
        ("/v1/positions/ublox", LINES),
    ],
)
def test_every_input_goes_with_every_output(hall_app: RunningApp, path: str, body: Any, output: str):
    response = post(hall_app, f"{path}?output={output}", body)
    assert response.status_code == 200
    native = post(hall_app, f"{path}?output=native", body).json()
    answers = response.json().get("results", [response.json()])
    fixes = native.get("results", [native])
    assert len(answers) == len(fixes)
    for answer, fix in zip(answers, fixes, strict=True):
        MODELS[output].model_validate(answer)
        position = answer.get("point") or dict(zip("xyz", answer["position"]["coordinates"], strict=True))
        assert position == fix["position"]


def test_a_native_answer_tells_what_became_of_the_messages_measurements(hall_app: RunningApp):
    message = copy.deepcopy(NRPPA)
    results = message["TRP-MeasurementResponseList"][0]["measurementResult"]
    results.insert(0, {"measuredResultsValue": {"ZoA": {"zenithAoA": 900}}})
    fix = AdaptedFixDocument.model_validate(post(hall_app, "/v1/positions/nrppa", message).json())
    assert fix.target_id == "ue-7"
    assert [outcome.source for outcome in fix.measurements] == [
        f"['TRP-MeasurementResponseList'][{n}].measurementResult[{k}].measuredResultsValue['{name}']"
        for n, k, name in [
            (0, 1, "uL-AngleOfArrival"),
            (0, 2, "uL-RTOA"),
            (1, 0, "uL-AngleOfArrival"),
            (1, 1, "uL-RTOA"),
        ]
    ]
    (skipped,) = fix.skipped
    assert skipped.source == "['TRP-MeasurementResponseList'][0].measurementResult[0].measuredResultsValue.ZoA"
    assert "without an azimuth" in skipped.reason


def test_one_bad_transmission_leaves_the_others_alone(hall_app: RunningApp):
    lines = LINES + LINES.replace("40871", "40872").replace('"bs2"', '"bs9"')
    good, bad = post(hall_app, "/v1/positions/ublox", lines).json()["results"]
    assert good["position"] is not None
    assert bad["status"] == 422
    assert bad["errors"][0]["path"] == "lines[4]"
    assert "station 'bs9' is not in the table" in bad["detail"]
    good, better = post(hall_app, "/v1/positions/ublox?station=bs9=bs2", lines).json()["results"]
    assert better["position"] == good["position"]


def test_a_known_height_moves_the_fix_there(hall_app: RunningApp):
    (plain,) = post(hall_app, "/v1/positions/ublox", LINES).json()["results"]
    (fixed,) = post(hall_app, "/v1/positions/ublox?height_m=1.5&height_stdev_m=0.01", LINES).json()["results"]
    assert fixed["position"]["z"] == pytest.approx(1.5, abs=0.03)
    assert fixed["vertical_accuracy_m"] < 0.02 < plain["vertical_accuracy_m"]
    message = {**SILABS, "height": {"z_m": 1.5, "stdev_m": 0.01}}
    assert post(hall_app, "/v1/positions/silabs", message).json()["position"]["z"] == pytest.approx(1.5, abs=0.03)


@pytest.mark.parametrize(
    ("path", "body", "status", "field", "words"),
    [
        ("/v1/positions?output=xml", REPORT, 422, "output", "output"),
        ("/v1/positions/nrppa", {**NRPPA, "stations": {}}, 422, None, "station '1' is not in the table"),
        ("/v1/positions/nrppa", LINES, 415, None, "application/json"),
        ("/v1/positions/ublox", NRPPA, 415, None, "text/plain"),
        ("/v1/positions/ublox", "OK", 422, None, "no line holds +UUDF:"),
        ("/v1/positions/ublox?confidence=2", LINES, 422, "confidence", "0.01 to 0.99"),
        ("/v1/positions/silabs", {**SILABS, "confidence": 1.0}, 422, "confidence", "to hold"),
        ("/v1/positions/ublox?station=a", LINES, 422, "station", "NAME=STATION"),
        ("/v1/positions/ublox?height_m=1", LINES, 422, "height", "give both numbers"),
        ("/v1/positions/silabs", {**SILABS, "angles": []}, 422, "angles", "an array of 1 to 256 angles"),
    ],
)
def test_refusals_are_problems(hall_app: RunningApp, path: str, body: Any, status: int, field: str | None, words: str):
    response = post(hall_app, path, body)
    assert response.status_code == status
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert words in problem["detail"]
    if field is not None:
        assert problem["errors"][0]["path"] == field


def test_without_position_there_is_a_problem_instead(hall_app: RunningApp):
    # A single time of arrival says nothing.
    report = {"measurements": [{"type": "toa", "station_id": "bs1", "range_m": 131.0, "stdev_m": 0.5}]}
    assert post(hall_app, "/v1/positions", report).json()["position"] is None
    response = post(hall_app, "/v1/positions?output=omlox", report)
    assert response.status_code == 422
    assert "ask for the native one" in response.json()["detail"]


def test_accuracies_hold_with_the_confidence_that_a_message_wants(hall_app: RunningApp):
    (lines,) = post(hall_app, "/v1/positions/ublox?confidence=0.95", LINES).json()["results"]
    (usual,) = post(hall_app, "/v1/positions/ublox", LINES).json()["results"]
    pairs = [(lines, usual)]
    for path, body in (("/v1/positions/nrppa", NRPPA), ("/v1/positions/silabs", SILABS)):
        pairs.append(tuple(post(hall_app, path, {**body, **more}).json() for more in ({"confidence": 0.95}, {})))
    for wanted, plain in pairs:
        assert (wanted["confidence"], plain["confidence"]) == (pytest.approx(0.95, abs=0.02), pytest.approx(0.68))
        assert wanted["horizontal_accuracy_m"] > 1.3 * plain["horizontal_accuracy_m"]
        assert wanted["position"] == plain["position"]


@pytest.mark.parametrize(("path", "body"), [("/v1/positions/nrppa", NRPPA), ("/v1/positions/silabs", SILABS)])
def test_a_batch_of_messages_is_answered_in_its_order(hall_app: RunningApp, path: str, body: dict[str, Any]):
    batch = {"reports": [body, {"confidence": "much", "colour": 1}, {**body, "target_id": "last"}]}
    response = post(hall_app, f"{path}/batch", batch)
    assert response.status_code == 200
    first, refused, last = response.json()["results"]
    alone = post(hall_app, path, body).json()
    assert {**first, "compute_ms": 0} == {**alone, "compute_ms": 0}
    assert refused["status"] == 422
    assert "colour" in [error["path"] for error in refused["errors"]]
    assert (last["target_id"], last["position"]) == ("last", alone["position"])
    torn = hall_app.post_bytes(f"{path}/batch", '{"reports": [{]}', {"content-type": "application/json"})
    assert torn.status_code == 400


def test_the_problems_of_a_batch_of_messages_stay_short(hall_app: RunningApp):
    wrong = {f"key-{n}": 1 for n in range(40)}
    results = post(hall_app, "/v1/positions/silabs/batch", {"reports": [wrong] * 20}).json()["results"]
    assert sum(len(problem["errors"]) for problem in results) < 120
    assert len(results[-1]["errors"]) == 1
    assert results[-1]["more_errors"] >= 39


def test_a_message_comes_back_as_the_report_that_it_was_turned_into(hall_app: RunningApp):
    for path, body in (("nrppa", NRPPA), ("silabs", SILABS), ("ublox", LINES)):
        answer = post(hall_app, f"/v1/positions/{path}?with_report=true", body).json()
        fix = answer.get("results", [answer])[0]
        again = post(hall_app, "/v1/positions", fix["report"]).json()
        assert list(again["position"].values()) == pytest.approx(list(fix["position"].values()), abs=1e-6)


@pytest.mark.parametrize(
    ("method", "path", "known"),
    [
        ("POST", "/v1/positions?ouput=omlox", "did you mean output? The path knows output, table, track"),
        ("POST", "/v1/positions/batch?confidence=0.9", "the path knows output, table, track"),
        ("POST", "/v1/positions/silabs?confidence=0.9", "the path knows output, table, track, with_report"),
        ("GET", "/v1/tables?table=hall", "the path knows none"),
        ("GET", "/v1/stations?name=bs1", "the path knows table"),
        ("GET", "/v1/fixes?target=agv-7", "did you mean target_id? The path knows table, target_id"),
        ("GET", "/livez?verbose", "the path knows none"),
    ],
)
def test_unknown_query_parameters_are_refused(hall_app: RunningApp, method: str, path: str, known: str):
    response = hall_app.post(path, REPORT) if method == "POST" else hall_app.get(path)
    assert response.status_code == 422
    problem = response.json()
    assert problem["type"] == "urn:rayfix:problem:invalid-parameter"
    name = path.split("?")[1].split("=")[0]
    assert problem["detail"] == f"there is no query parameter '{name}'; {known}"
    assert [error["path"] for error in problem["errors"]] == [name]
