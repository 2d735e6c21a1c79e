"""The page of the HTTP interface in a real browser: all of it from the service, and an example tried out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def test_an_example_is_tried_out(hall_url: str, open_page: Callable[..., Any], artefacts: Path) -> None:
    page = open_page(f"{hall_url}/docs", ready=False)
    operation = page.locator(".opblock", has_text="Locate one report")
    operation.get_by_role("button").first.click()
    operation.get_by_role("button", name="Try it out").click()
    operation.get_by_role("button", name="Execute").click()
    answer = operation.locator(".live-responses-table")
    expect(answer.locator(".response-col_status").nth(1)).to_contain_text("200")
    expect(answer).to_contain_text('"status": "ok"')
    page.screenshot(path=artefacts / "interface.png", full_page=True)
    licences = page.evaluate("document.querySelector('#licences').href")
    assert "MIT" in httpx.get(licences, trust_env=False).text


def test_a_schema_is_shown(hall_url: str, open_page: Callable[..., Any]) -> None:
    page = open_page(f"{hall_url}/docs", ready=False)
    expect(page.get_by_role("heading", name="rayfix")).to_be_visible()
    page.locator(".model-container, .json-schema-2020-12", has_text="AngleOfArrival").last.get_by_role(
        "button"
    ).first.click()
    expect(page.get_by_text("los_probability").first).to_be_visible()
