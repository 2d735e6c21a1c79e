"""A site on map coordinates: what the viewer shows is in the map's frame, and paths are explained as elsewhere."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from rayfix_offline.build import build_table
from tests.support.running.server_process import start_rayfix_serve
from tests.support.scenes.map_site import POSITIONS, SHIFT, UE, report, write_site


@pytest.fixture(scope="module")
def map_url(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a service of a room on map coordinates."""
    site = write_site(tmp_path_factory.mktemp("map") / "far", SHIFT)
    build_table(site, site.with_suffix(".h5"), jobs=1)
    with start_rayfix_serve(site.with_suffix(".h5")) as server:
        yield server.url


def test_everything_is_in_the_frame_of_the_map(open_page: Callable[..., Any], map_url: str, artefacts: Path) -> None:
    page = open_page(map_url)
    page.wait_for_selector("#connection.live")
    answer = httpx.post(f"{map_url}/v1/positions", json=report(target_id="ue"), trust_env=False, timeout=30).json()
    page.wait_for_selector(".coordinates")
    shown = [float(text.strip("xyz\n")) for text in page.locator(".coordinates span:not(.unit)").all_inner_texts()]
    position = np.array([answer["position"][axis] for axis in "xyz"])
    np.testing.assert_allclose(shown, position, atol=0.06)
    assert np.linalg.norm(position - (UE + SHIFT)) < 0.5

    page.keyboard.press("2")
    page.wait_for_timeout(900)
    x, y = page.evaluate(
        """p => {
            const v = rayfixViewer.stage.local(p).project(rayfixViewer.stage.camera);
            return [(v.x + 1) / 2 * innerWidth, (1 - v.y) / 2 * innerHeight];
        }""",
        position.tolist(),
    )
    page.mouse.move(x, y)
    cursor = [float(text) for text in re.findall(r"-?\d+\.?\d*", page.locator("#cursor").inner_text())]
    np.testing.assert_allclose(cursor, position[:2], atol=0.06)
    page.screenshot(path=artefacts / "map.png")

    paths = page.evaluate("() => [...rayfixViewer.explained.paths].map(([station, path]) => [station, path.points])")
    assert {station for station, _ in paths} == {"b", "c"}  # the pillar is between the UE and a
    for station, points in paths:
        np.testing.assert_allclose(points, [POSITIONS[station] + SHIFT, position], atol=1e-3)
