"""Names that hold HTML and scripts, in a real browser: shown as text, and no script but the page's own runs."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from rayfix.cli import main
from rayfix_tables.site import Station
from tests.support.running.server_process import start_rayfix_serve
from tests.support.tables.hand_tables import POSITIONS, UE, line_of_sight, table_of

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

OpenPage = Callable[..., Any]

SCRIPT = "<script>window.ran=1</script>"
IMAGE = "<img src=x onerror=window.ran=1>"
CLOSING = "</script></style></title><svg onload=window.ran=1>"
HOSTILE = [SCRIPT, IMAGE, CLOSING, "'\"><iframe srcdoc='<script>parent.ran=1</script>'>", "${window.ran=1}"]
DRAWING = "<svg onload=window.ran=1>"
NAMES = {"a": IMAGE, "b": DRAWING, "c": "<b onclick=window.ran=1 style=position:fixed;inset:0>"}


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a table whose file and stations have such names; a build refuses them, a table need not come from one."""
    path = tmp_path_factory.mktemp("hostile") / "<img src=x onerror=ran=1>.h5"
    stations = {name: Station(id=name, position=POSITIONS[old]) for old, name in NAMES.items()}
    tubes = [replace(line_of_sight(old), station_id=name) for old, name in NAMES.items()]
    table_of(path, *tubes, stations=stations)
    return path


def report(target: str) -> dict[str, Any]:
    """Return a report of all stations, of the line of sight."""
    measurements = [
        {"type": "pt", "station_id": name, "range_m": sum((UE - POSITIONS[old]) ** 2) ** 0.5, "stdev_m": 0.5}
        for old, name in NAMES.items()
    ]
    return {"target_id": target, "measurements": measurements}


def assert_nothing_ran(page: Any) -> None:
    page.wait_for_timeout(300)
    assert page.evaluate("window.ran") is None
    assert page.locator("img[src=x], iframe, svg[onload]").count() == 0


def test_the_viewer_shows_names_as_text(browser: Any, open_page: OpenPage, table: Path) -> None:
    with start_rayfix_serve(table) as server:
        page = open_page(server.url)
        page.wait_for_selector("#connection.live", state="attached")
        for name in HOSTILE:
            answer = httpx.post(f"{server.url}/v1/positions", json=report(name), trust_env=False, timeout=30)
            assert answer.status_code == 200, answer.text
            expect(page.locator("li[role=option]").filter(has_text=name).first).to_be_attached()
        assert_nothing_ran(page)
        assert set(page.locator(".label.station").all_inner_texts()) >= {IMAGE, DRAWING}
        for tab in page.get_by_role("tab").all():
            tab.click()
            assert_nothing_ran(page)


def test_the_viewer_shows_problems_as_text(browser: Any, table: Path) -> None:
    """The browser logs the refusal as an error, so that this page is not one of those that may log nothing."""
    with start_rayfix_serve(table) as server:
        page = browser.new_page()
        page.goto(server.url)
        page.wait_for_selector("html[data-ready]")
        page.keyboard.press("v")
        wrong = {"measurements": [{"type": IMAGE}, {"type": "pt", "station_id": SCRIPT, CLOSING: 1}], IMAGE: SCRIPT}
        page.fill("textarea", json.dumps(wrong))
        with page.expect_response("**/v1/positions*") as refused:
            page.get_by_role("button", name="Locate", exact=True).click()
        assert refused.value.status == 422
        expect(page.locator("dialog .warning").first).to_contain_text(IMAGE)
        assert_nothing_ran(page)
        page.close()


def test_the_page_of_the_interface_shows_answers_as_text(browser: Any, table: Path) -> None:
    with start_rayfix_serve(table) as server:
        page = browser.new_page()
        page.goto(f"{server.url}/docs?x={SCRIPT}#/{IMAGE}")
        operation = page.locator(".opblock", has_text="Locate one report")
        operation.get_by_role("button").first.click()
        operation.get_by_role("button", name="Try it out").click()
        for document, status in ((report(IMAGE), "200"), ({IMAGE: SCRIPT, "measurements": [{"type": IMAGE}]}, "422")):
            operation.locator("textarea.body-param__text").fill(json.dumps(document))
            operation.get_by_role("button", name="Execute").click()
            answer = operation.locator(".live-responses-table")
            expect(answer.locator(".response-col_status").nth(1)).to_contain_text(status)
            expect(answer).to_contain_text(IMAGE)
            assert_nothing_ran(page)
        page.close()


def test_what_the_service_answers_is_never_a_page(browser: Any, table: Path) -> None:
    """An address that holds a script is answered by a problem in JSON, which a browser shows as text."""
    with start_rayfix_serve(table) as server:
        page = browser.new_page()
        for path in (f"/v1/{IMAGE}", f"/v1/table?table={IMAGE}", f"/v1/stations/{SCRIPT}/coverage", "/v1/tables"):
            answer = page.goto(server.url + path)
            assert answer is not None
            assert "json" in answer.headers["content-type"]
            assert_nothing_ran(page)
        page.close()


def test_a_page_from_disk_shows_names_as_text(open_page: OpenPage, table: Path, tmp_path: Path) -> None:
    reports = {"reports": [report(name) for name in HOSTILE]}
    (tmp_path / "reports.json").write_text(json.dumps(reports), encoding="utf-8")
    assert main(["view", str(table), str(tmp_path / "reports.json"), "-o", str(tmp_path / "fix.html")]) == 0
    page = open_page((tmp_path / "fix.html").as_uri())
    for name in HOSTILE:
        expect(page.locator("li[role=option]").filter(has_text=name).first).to_be_attached()
    assert_nothing_ran(page)
