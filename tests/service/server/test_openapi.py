"""The service's description of itself: its examples work, its references lead somewhere, its errors are problems."""

import json
import re
from typing import Any

import pytest

from rayfix_service.http.openapi.examples import (
    BATCH_EXAMPLES,
    NRPPA_BATCH_EXAMPLES,
    NRPPA_EXAMPLES,
    PROBLEM_EXAMPLE,
    REPORT_EXAMPLES,
    SILABS_BATCH_EXAMPLES,
    SILABS_EXAMPLES,
    UBLOX_EXAMPLES,
)
from tests.support.messages.reports import changed
from tests.support.running.running_app import RunningApp


@pytest.fixture
def openapi(hall_app: RunningApp) -> dict[str, Any]:
    return hall_app.get("/openapi.json").json()


def test_every_example_of_the_openapi_document_works(hall_app: RunningApp, openapi: dict[str, Any]):
    tried = 0
    for path, operations in openapi["paths"].items():
        if not path.startswith("/v1/positions"):
            continue  # test_web.py has the viewer's
        content = operations.get("post", {}).get("requestBody", {}).get("content", {})
        ((media_type, body),) = content.items() or ((None, {}),)
        for example in body.get("examples", {}).values():
            value = example["value"]
            data = value if isinstance(value, str) else json.dumps(value)
            response = hall_app.post_bytes(path, data, {"content-type": str(media_type)})
            assert response.status_code == 200, response.text
            for fix in response.json().get("results", [response.json()]):
                assert fix["position"] is not None
                assert fix["status"] in ("ok", "ambiguous")
                assert all(measurement["used"] for measurement in fix["measurements"])
            tried += 1
    singles = (REPORT_EXAMPLES, NRPPA_EXAMPLES, SILABS_EXAMPLES, UBLOX_EXAMPLES)
    examples = (*singles, BATCH_EXAMPLES, NRPPA_BATCH_EXAMPLES, SILABS_BATCH_EXAMPLES)
    assert tried == sum(len(group) for group in examples)


def test_every_reference_of_the_openapi_document_leads_somewhere(openapi: dict[str, Any]):
    schemas = openapi["components"]["schemas"]
    references = set(re.findall(r'"\$ref": "([^"]*)"', json.dumps(openapi)))
    assert references
    for reference in references:
        assert reference.removeprefix("#/components/schemas/") in schemas
    for name in ("ReportDocument", "BatchDocument", "AngleDocument", "FixDocument", "Problem"):
        assert f"#/components/schemas/{name}" in references


def test_every_error_of_the_openapi_document_is_a_problem(openapi: dict[str, Any]):
    assert "HTTPValidationError" not in json.dumps(openapi)
    statuses: dict[str, set[str]] = {}
    for path, operations in openapi["paths"].items():
        for operation in operations.values():
            statuses[path] = set(operation["responses"])
            for status, response in operation["responses"].items():
                if status != "200":
                    schema = response["content"]["application/problem+json"]["schema"]
                    assert schema == {"$ref": "#/components/schemas/Problem"}
                    assert list(response["content"]) == ["application/problem+json"]
    position = {"200", "400", "401", "404", "413", "415", "422", "429", "503", "504"}
    assert statuses == {
        "/v1/positions": position,
        "/v1/positions/batch": position,
        "/v1/positions/nrppa": position,
        "/v1/positions/nrppa/batch": position,
        "/v1/positions/silabs": position,
        "/v1/positions/silabs/batch": position,
        "/v1/positions/ublox": position - {"400"},
        "/v1/fixes": {"200", "401", "404", "422", "503"},
        "/v1/table": {"200", "401", "404", "422", "503"},
        "/v1/tables": {"200", "401", "422", "503"},
        "/v1/tables/reload": {"200", "401", "409", "422", "429"},
        "/v1/stations": {"200", "401", "404", "422", "503"},
        "/v1/viewer": {"200", "401", "404", "422", "503"},
        "/v1/scene.glb": {"200", "401", "404", "422", "503"},
        "/v1/stations/{station_id}/mixture": {"200", "401", "404", "422", "429", "503", "504"},
        "/v1/stations/{station_id}/coverage": {"200", "401", "404", "422", "429", "503", "504"},
        "/v1/simulations": position | {"403"},
        "/v1/posteriors": position,
        "/livez": {"200", "422"},
        "/readyz": {"200", "422", "503"},
        "/metrics": {"200", "401", "422", "503"},
    }


def test_the_example_of_a_problem_is_what_comes(hall_app: RunningApp):
    response = hall_app.post("/v1/positions", changed(0, azimuth_stdev_deg=-1))
    assert response.json() == PROBLEM_EXAMPLE


def test_the_docs_are_there(hall_app: RunningApp):
    """Also where the page is not built; nothing in it, nor in what it may get, is of another address."""
    response = hall_app.get("/docs")
    assert response.status_code == 200
    assert '"openapi.json"' in response.text
    assert "//" not in response.text
    policy = response.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
    assert "unsafe" not in policy
