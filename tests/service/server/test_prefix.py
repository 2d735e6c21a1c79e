"""The service below a path of a proxy's: with the prefix and without it, and in the OpenAPI document."""

from pathlib import Path

import pytest

from rayfix_service.http.access.keys import add_key
from rayfix_service.http.access.prefix import is_prefix
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp


def servers(app: RunningApp, path: str = "/openapi.json", **headers: str) -> list[dict[str, str]]:
    return (
        app.get(path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        .json()
        .get("servers", [])
    )


def test_both_forms_of_a_path_are_one(hall_table_path: Path):
    with RunningApp(hall_table_path, root_path="/sites/north") as app:
        for prefix in ("", "/sites/north"):
            assert app.post(f"{prefix}/v1/positions", REPORT).json()["status"] == "ok"
            assert app.post(f"{prefix}/v1/positions?output=omlox", REPORT).status_code == 200
            assert servers(app, f"{prefix}/openapi.json") == [{"url": "/sites/north"}]
            assert app.get(f"{prefix}/docs").status_code == 200
        assert app.get("/sites/northern/v1/table").status_code == 404
        assert app.get("/sites/north/sites/north/v1/table").status_code == 404
        folder = app.get("/sites/north?a=1")
        assert (folder.status_code, folder.headers["location"]) == (308, "/sites/north/?a=1")
        # Who is asked for it must not choose where the client is sent.
        assert servers(app, x_forwarded_prefix="/evil") == [{"url": "/sites/north"}]


def test_a_header_names_the_prefix_only_where_it_is_trusted(hall_app: RunningApp, hall_table_path: Path):
    assert servers(hall_app, x_forwarded_prefix="/rayfix") == []
    with RunningApp(hall_table_path, trust_forwarded_prefix=True) as app:
        assert servers(app) == []
        assert servers(app, x_forwarded_prefix="/rayfix/") == [{"url": "/rayfix"}]
        for odd in (
            "//evil.example",
            "https://evil.example",
            "/a/../b",
            "/a b",
            "/<script>",
            "/x" * 101,
            "/.well-known",
        ):
            assert servers(app, x_forwarded_prefix=odd) == []
        # It takes nothing off the path.
        assert app.get("/rayfix/v1/table", headers={"x-forwarded-prefix": "/rayfix"}).status_code == 404


def test_a_prefix_opens_nothing(hall_table_path: Path, tmp_path: Path):
    key = add_key(tmp_path / "keys", "a")
    with RunningApp(hall_table_path, root_path="/docs", api_keys=tmp_path / "keys") as app:
        for path in ("/docs/v1/table", "/v1/table", "/docs/docs/v1/table", "/docs//v1/table"):
            assert app.get(path).status_code in (401, 404)
        assert app.get("/docs/v1/table").status_code == 401
        assert app.get("/docs/v1/table", headers={"x-api-key": key}).status_code == 200
        assert app.get("/docs/docs").status_code == 200


@pytest.mark.parametrize("text", ["", "/", "rayfix", "/a/", "/a//b", "/.", "/a/..", "/a%2f", "/a\n"])
def test_what_is_no_prefix(text: str):
    assert not is_prefix(text)
