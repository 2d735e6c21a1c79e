"""Tracks in a real browser: drawn beside the fixes, with region, trail and state, and hidden when asked."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from rayfix.example.drop import example_paths, report_text, simulate_example_report
from tests.support.running.server_process import start_rayfix_serve

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


@pytest.fixture(scope="module")
def tracking_url(hall_table_path: Path, browser: Any) -> Iterator[str]:
    """Address of a service that follows targets."""
    with start_rayfix_serve(hall_table_path, "--track") as server:
        yield server.url


def send(url: str, seconds: float, **more: Any) -> dict[str, Any]:
    """Send the example's report as of a time."""
    report = json.loads(report_text(simulate_example_report(example_paths())))
    document = {**report, "target_id": "agv-7", "timestamp": f"2026-01-31T10:00:{seconds:06.3f}Z", **more}
    answer = httpx.post(f"{url}/v1/positions", json=document, trust_env=False, timeout=30)
    assert answer.status_code == 200, answer.text
    return answer.json()


DRAWN = """() => {
    const { group, drawn } = rayfixViewer.targets;
    const regions = group.children[1].children.filter((one) => one.visible);
    const { fixes, track } = drawn.get("agv-7");
    const centre = regions.length ? [12, 13, 14].map((n) => regions[0].matrix.elements[n]) : null;
    return { regions: regions.length, centre,
             fixes: fixes.visible, track: track.visible, points: track.geometry.drawRange.count };
}"""


def test_a_track_is_drawn_beside_the_fix(open_page: Callable[..., Any], tracking_url: str, artefacts: Path) -> None:
    page = open_page(tracking_url)
    page.wait_for_selector("#connection.live")
    for n in range(3):
        answer = send(tracking_url, 0.5 * n)
        assert answer["track"]["state"] == ("updated" if n else "started")
        expect(page.locator(".track .facts dt:has-text('reports') + dd")).to_have_text(str(n + 1))
    track = answer["track"]
    expect(page.locator(".label.track")).to_have_text("track updated")
    expect(page.locator("#legend")).to_contain_text("track, 2")
    expect(page.locator("li[role=option]")).to_contain_text("updated")
    page.wait_for_timeout(1500)
    page.screenshot(path=artefacts / "track.png")

    drawn = page.evaluate(DRAWN)
    assert (drawn["regions"], drawn["fixes"], drawn["track"], drawn["points"]) == (1, True, True, 3)
    origin = np.array(page.evaluate("rayfixViewer.stage.origin"))
    np.testing.assert_allclose(np.array(drawn["centre"]) + origin, [track["position"][a] for a in "xyz"], atol=1e-5)
    shown = [
        float(text.strip("xyz\n")) for text in page.locator(".track .coordinates span:not(.unit)").all_inner_texts()
    ]
    # Two digits of each deviation are shown.
    deviations = np.sqrt(np.diag(track["covariance_m2"]))
    assert np.all(np.abs(np.array(shown) - [track["position"][a] for a in "xyz"]) <= 0.06 * deviations)

    page.get_by_label("Tracks").uncheck()
    page.wait_for_timeout(600)
    assert page.evaluate(DRAWN)["regions"] == 0
    assert not page.evaluate(DRAWN)["track"]
    page.get_by_label("Tracks").check()
    page.get_by_label("Fixes").uncheck()
    page.wait_for_timeout(600)
    drawn = page.evaluate(DRAWN)
    assert (drawn["fixes"], drawn["track"]) == (False, True)
    expect(page.locator(".label.target")).to_be_visible()  # the name is at the track

    # After a long pause the track, and with it its trail, begins anew.
    assert send(tracking_url, 30.0)["track"]["state"] == "restarted"
    expect(page.locator(".label.track")).to_have_text("track restarted")
    assert not page.evaluate(DRAWN)["track"]
    assert send(tracking_url, 20.0)["track"]["state"] == "late"
    expect(page.locator(".track .chip")).to_have_text("late")


def test_without_tracking_nothing_speaks_of_tracks(open_page: Callable[..., Any], hall_url: str) -> None:
    page = open_page(hall_url)
    page.wait_for_selector("#connection.live")
    send(hall_url, 0.0)
    page.wait_for_selector(".coordinates")
    assert page.locator(".track").count() == 1  # the label, which is hidden
    expect(page.locator(".label.track")).to_be_hidden()
    assert "track" not in page.locator("#legend").inner_text()
