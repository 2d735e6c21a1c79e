"""A log is played in a real browser: in a page of its own, and dropped on the viewer of a service."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rayfix.cli import main
from tests.support.messages.walks import write_walk

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

COUNT = 8

SEEN = """() => {
    const target = rayfixViewer.store.targets.get("agv-7");
    return { fixes: target.trail.length, truths: target.truths.length, track: target.track.trail.length };
}"""
DROP = """text => {
    const data = new DataTransfer();
    data.items.add(new File([text], "walk.jsonl"));
    document.querySelector("#stage").dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true }));
}"""


@pytest.fixture(scope="module")
def walk(hall_table_path: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write fixes of a walk with their reports, and the page that plays them beside the truth."""
    folder = tmp_path_factory.mktemp("walk")
    log, truth, fixes, page = (folder / name for name in ("log.jsonl", "truth.csv", "fixes.jsonl", "walk.html"))
    write_walk(log, truth, num_reports=COUNT)
    located = ["locate", str(hall_table_path), str(log), "-o", str(fixes), "--track", "--with-reports", "--no-progress"]
    assert main([*located, "--jobs", "1"]) == 0
    assert main(["view", str(hall_table_path), "--fixes", str(fixes), "--truth", str(truth), "-o", str(page)]) == 0
    return fixes, page


def test_a_page_plays_a_log_beside_the_truth(
    open_page: Callable[..., Any], walk: tuple[Path, Path], artefacts: Path
) -> None:
    page = open_page(walk[1].as_uri())
    player = page.locator("#player")
    expect(player).to_contain_text(f"fixes.jsonl, {COUNT} fixes")
    assert page.evaluate(SEEN) == {"fixes": 1, "truths": 1, "track": 1}
    page.get_by_label("Speed").select_option("10")
    page.keyboard.press("Space")
    expect(player.locator("output")).to_have_text("10:00:03.5")
    expect(player.get_by_role("button", name="Play (Space)")).to_be_visible()
    assert page.evaluate(SEEN) == {"fixes": COUNT, "truths": COUNT, "track": COUNT}
    error = page.locator("dt:has-text('true error') + dd").inner_text()
    assert 0.0 < float(error.split()[0]) < 1.5
    page.wait_for_timeout(1500)
    page.screenshot(path=artefacts / "log.png")

    # Back to the middle: only what had come by then is there.
    page.locator("#player input").fill("500")
    expect(player.locator("output")).to_have_text("10:00:01.7")
    assert page.evaluate(SEEN) == {"fixes": 4, "truths": 4, "track": 4}
    assert page.locator("table.measurements tr").count() >= 4


def test_a_log_is_dropped_on_the_viewer_of_a_service_and_closed(
    open_page: Callable[..., Any], walk: tuple[Path, Path], hall_url: str
) -> None:
    page = open_page(hall_url)
    page.wait_for_selector("#connection.live", state="attached")
    text = walk[0].read_text(encoding="utf-8")
    page.evaluate(DROP, text.replace('"status"', '"state"', 1))
    expect(page.locator(".notice, [role=alert]").first).to_contain_text("Line 1 is no fix")
    page.evaluate(DROP, text)
    expect(page.locator("#player")).to_contain_text(f"walk.jsonl, {COUNT} fixes")
    page.get_by_role("button", name="Close the log").click()
    expect(page.locator("#player")).to_be_hidden()
    assert page.evaluate("rayfixViewer.store.targets.size") == 0
