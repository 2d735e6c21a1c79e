"""Pictures of the documentation: ``make screenshots``.

The UE is where no station sees it. Each of the four hears it by one reflection or more.
"""

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from rayfix.cli import main
from rayfix.example.drop import EXAMPLE_NOISE
from rayfix.example.files import write_example
from rayfix.example.hall import hall_scene, hall_stations
from rayfix_evaluation.drops.simulate import simulate_report
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_offline.build import build_table
from tests.support.messages.walks import write_walk
from tests.support.running.server_process import start_rayfix_serve

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
HIDDEN = np.array([4.7, 6.2, 0.9])


@pytest.fixture(scope="module")
def full_table(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the hall's full table, that of the demo where it was run."""
    table = ROOT / "demo" / "hall.h5"
    if not table.is_file():
        folder = tmp_path_factory.mktemp("hall")
        table = folder / "hall.h5"
        build_table(write_example(folder), table)
    return table


@pytest.fixture(scope="module")
def url(full_table: Path) -> Iterator[str]:
    """Address of a service of that table."""
    with start_rayfix_serve(full_table) as server:
        yield server.url


def hidden_report() -> dict[str, Any]:
    mesh = hall_scene().to_geometry()
    solver = ForwardSolver.from_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    paths = {name: solver.paths(np.array(position), HIDDEN) for name, position in hall_stations()}
    assert all(len(found) and found.num_reflections.min() > 0 for found in paths.values())
    return simulate_report(paths, EXAMPLE_NOISE, rng=np.random.default_rng(1), timing="pt", target_id="agv-7")


def save(page: Any, name: str) -> None:
    """Keep what is seen, once it stands still."""
    page.wait_for_timeout(2500)
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(DOCS / name, optimize=True)


def test_screenshots_of_the_viewer(open_page: Callable[..., Any], url: str):
    page = open_page(url)
    page.wait_for_selector("#connection.live")
    httpx.post(f"{url}/v1/positions", json=hidden_report(), trust_env=False).raise_for_status()
    page.wait_for_selector(".coordinates")
    save(page, "viewer-fix.png")
    page.keyboard.press("t")
    page.keyboard.press("2")
    save(page, "viewer-plan.png")
    page.keyboard.press("t")
    page.keyboard.press("1")
    page.keyboard.press("i")
    page.wait_for_selector(".components tbody tr")
    save(page, "viewer-table.png")


def test_screenshot_of_a_log(open_page: Callable[..., Any], full_table: Path, tmp_path: Path):
    log, truth, fixes, view = (tmp_path / name for name in ("log.jsonl", "truth.csv", "walk.jsonl", "walk.html"))
    write_walk(log, truth, num_reports=25, seconds=0.2)
    located = ["locate", str(full_table), str(log), "-o", str(fixes), "--track", "--with-reports", "--no-progress"]
    assert main(located) == 0
    assert main(["view", str(full_table), "--fixes", str(fixes), "--truth", str(truth), "-o", str(view)]) == 0
    page = open_page(view.as_uri())
    page.locator("#player input").fill("700")
    save(page, "viewer-log.png")


def test_picture_for_a_paper(url: str, tmp_path: Path):
    write_example(tmp_path)
    table = ROOT / "demo" / "hall.h5"
    if not table.is_file():
        pytest.skip("make demo first")
    assert main(["plot", str(table), str(tmp_path / "report.json"), "-o", str(tmp_path / "plot.png")]) == 0
    picture = Image.open(tmp_path / "plot.png").convert("RGB")
    # Without refinement by k-means, the little red there is would turn brown.
    picture.quantize(128, method=Image.Quantize.MEDIANCUT, kmeans=1, dither=Image.Dither.NONE).save(
        DOCS / "plot-report.png", optimize=True
    )
