"""What a screen has room for, from a phone to a desk, dark and light; and what measures views along an axis."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from rayfix.example.drop import example_paths, report_text, simulate_example_report

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

OpenPage = Callable[..., Any]

SIZES = {390: 844, 768: 1024, 1440: 900}

HEADER = """() => [...document.querySelectorAll("#bar button, #bar a, #bar nav, #site, #connection")]
    .map((one) => one.getBoundingClientRect()).filter((box) => box.width > 0)
    .map(({ left, right, top, bottom }) => [left, right, top, bottom])"""

BOXES = """elements => elements.map((one) => one.getBoundingClientRect())
    .map(({ left, right, top, bottom }) => [left, right, top, bottom])"""

PIXEL = """p => {
    const { stage } = rayfixViewer;
    const v = stage.local(p).project(stage.camera);
    return [(v.x + 1) / 2 * innerWidth, (1 - v.y) / 2 * innerHeight];
}"""


def post_example(url: str) -> None:
    report = json.loads(report_text(simulate_example_report(example_paths())))
    httpx.post(f"{url}/v1/positions", json=report, trust_env=False, timeout=30).raise_for_status()


@pytest.mark.parametrize("scheme", ["dark", "light"])
@pytest.mark.parametrize("width", SIZES)
def test_all_of_the_header_is_on_the_screen(
    open_page: OpenPage, hall_url: str, artefacts: Path, width: int, scheme: str
) -> None:
    page = open_page(hall_url, size=(width, SIZES[width]), scheme=scheme)
    page.wait_for_selector("#connection.live", state="attached")
    post_example(hall_url)
    page.wait_for_selector(".label.target.selected")
    page.keyboard.press("2")
    page.mouse.move(width / 2, SIZES[width] / 2)
    page.wait_for_timeout(900)
    page.screenshot(path=artefacts / f"plan-{width}-{scheme}.png")
    boxes = page.evaluate(HEADER)
    assert all(left >= 0 and right <= width for left, right, _, _ in boxes), boxes
    bar = page.locator("#bar").bounding_box()
    assert all(top >= 0 and bottom <= bar["height"] for _, _, top, bottom in boxes), boxes
    for n, (left, right, top, bottom) in enumerate(boxes):
        for other in boxes[n + 1 :]:
            inside = left < other[1] and other[0] < right and top < other[3] and other[2] < bottom
            apart = right <= other[0] + 1 or other[1] <= left + 1 or bottom <= other[2] or other[3] <= top
            # A tab is within the group of the tabs, and beside the other one.
            within = left <= other[0] and other[1] <= right and top <= other[2] and other[3] <= bottom
            assert apart or within or not inside, (boxes[n], other)
    stations = page.eval_on_selector_all(".label.station:not([hidden])", BOXES)
    assert len(stations) == 4
    assert all(left >= 0 and right <= width for left, right, _, _ in stations), stations
    if width == 390:
        page.locator("#open-right").click()
        page.wait_for_timeout(500)
        page.screenshot(path=artefacts / f"details-{width}-{scheme}.png")
        assert page.locator("#right").bounding_box()["y"] == bar["height"]
        expect(page.locator("#legend")).to_be_hidden()  # no room beside the panel
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize(("key", "axes", "other"), [("2", "xy", 2), ("3", "yz", 0)])
def test_the_pointer_has_coordinates(
    open_page: OpenPage, hall_url: str, artefacts: Path, key: str, axes: str, other: int
) -> None:
    page = open_page(hall_url)
    expect(page.locator("#rulers")).to_be_hidden()
    page.keyboard.press(key)
    expect(page.locator("#rulers")).to_be_visible()
    page.wait_for_timeout(600)
    place = [3.5, 9.25, 1.75]
    x, y = page.evaluate(PIXEL, place)
    page.mouse.move(x, y)
    shown = page.locator("#cursor").inner_text()
    assert "".join(re.findall("[xyz]", shown)) == axes
    found = [float(text) for text in re.findall(r"-?\d+\.?\d*", shown)]
    assert found == pytest.approx([value for n, value in enumerate(place) if n != other], abs=0.06)
    names = page.locator("#rulers .name").all_text_contents()
    assert sorted(names) == [f"{axis}, m" for axis in axes]
    assert page.locator("#rulers line").count() > 6
    # The bar is as long as it says.
    metres = float(page.locator("#scale-bar").inner_text().split()[0])
    width = page.locator("#scale-bar").bounding_box()["width"]
    ends = [page.evaluate(PIXEL, [place[0], at, place[2]])[0] for at in (0.0, metres)]
    across = [page.evaluate(PIXEL, [at, place[1], place[2]])[0] for at in (0.0, metres)]
    assert width == pytest.approx(max(abs(ends[1] - ends[0]), abs(across[1] - across[0])), abs=2.0)
    assert page.locator("#north").is_visible() == (key == "2")
    page.screenshot(path=artefacts / f"rulers-{axes}.png")
    page.mouse.move(2, 300)
    expect(page.locator("#cursor")).to_be_hidden()
    page.keyboard.press("1")
    expect(page.locator("#rulers")).to_be_hidden()


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_the_interface_is_linked_and_as_dark_as_the_viewer(
    open_page: OpenPage, hall_url: str, artefacts: Path, scheme: str
) -> None:
    page = open_page(hall_url, scheme=scheme)
    page.locator("#docs").click()
    page.wait_for_selector(".opblock")
    page.screenshot(path=artefacts / f"interface-{scheme}.png")
    background = page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
    assert background == ("rgb(28, 32, 34)" if scheme == "dark" else "rgba(0, 0, 0, 0)")
    page.get_by_role("link", name="Viewer", exact=True).click()
    page.wait_for_selector("html[data-ready]")
    page.keyboard.press("t")  # the choice holds for both pages
    page.locator("#docs").click()
    page.wait_for_selector(".opblock")
    assert page.evaluate("document.documentElement.classList.contains('dark-mode')") == (scheme == "light")
