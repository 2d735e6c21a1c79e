"""When the service answers: alive at once, ready once it can locate, and never with a damaged table."""

import logging
import threading
from pathlib import Path

import pytest

from rayfix_service.locator import Locator
from rayfix_service.server.server import serve
from rayfix_tables.errors import TableError
from tests.support.messages.problems import problem_of
from tests.support.running.running_app import RunningApp
from tests.support.tables.damage import flip_a_bit


def test_alive_at_once_and_ready_later(hall_table_path: Path, monkeypatch: pytest.MonkeyPatch):
    gate = threading.Event()
    warm_up = Locator.warm_up

    def wait_and_warm_up(self: Locator) -> None:
        gate.wait(60)
        warm_up(self)

    monkeypatch.setattr(Locator, "warm_up", wait_and_warm_up)
    with RunningApp(hall_table_path, ready=False) as app:
        try:
            assert app.get("/livez").json() == {"status": "alive"}
            for method, path in [
                ("GET", "/readyz"),
                ("GET", "/v1/table"),
                ("GET", "/v1/stations"),
                ("POST", "/v1/positions"),
                ("POST", "/v1/positions/batch"),
            ]:
                response = app.request(method, path)
                assert "/readyz" in problem_of(response, 503)["detail"]
                assert response.headers["retry-after"] == "1"
        finally:
            gate.set()
        app.wait_until_ready()
        ready = app.get("/readyz").json()
        table_id = app.get("/v1/table").json()["table_id"]
        assert ready == {"status": "ready", "tables": [{"name": "hall", "table_id": table_id}], "refused": []}


@pytest.fixture
def damaged_table_path(hall_table_copy: Path) -> Path:
    """Return a table that opens, with one bit of one number wrong."""
    flip_a_bit(hall_table_copy, "scene/vertices_m")
    return hall_table_copy


def test_a_damaged_table_is_not_served(damaged_table_path: Path):
    with pytest.raises(TableError, match=r"copy\.h5 is damaged: the checksum of scene/vertices_m.*build it again"):
        serve(damaged_table_path)


def test_a_damaged_table_is_never_ready(damaged_table_path: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.ERROR), RunningApp(damaged_table_path, ready=False) as app:
        app.wait_for(lambda: "does not pass" in app.get("/readyz").text)
        for path in ("/readyz", "/v1/table"):
            response = app.get(path)
            document = problem_of(response, 503)
            assert "replace it" in document["detail"]
            assert "copy.h5" not in document["detail"]
            assert "retry-after" not in response.headers
        assert app.get("/livez").status_code == 200
    assert "copy.h5" in caplog.text
