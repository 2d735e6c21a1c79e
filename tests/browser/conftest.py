"""A real browser on a real service. The tests skip where there is no Chromium or the viewer is not built."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from rayfix_service.web.assets import load_assets
from tests.support.checkout import ROOT
from tests.support.running.server_process import start_rayfix_serve

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

ARTEFACTS = ROOT / "browser-artefacts"

FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL in software
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="session")
def artefacts() -> Path:
    """Folder of screenshots and figures, to be looked at."""
    ARTEFACTS.mkdir(exist_ok=True)
    return ARTEFACTS


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Return Chromium as the system has it."""
    executable = next((found for name in ("chromium", "chromium-browser") if (found := shutil.which(name))), None)
    if executable is None:
        pytest.skip("there is no Chromium; install the package chromium")
    if not load_assets():
        pytest.skip("the viewer is not built; run make viewer")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def hall_url(hall_table_path: Path, browser: Any) -> Iterator[str]:
    """Address of a service of the small table of the hall."""
    with start_rayfix_serve(hall_table_path) as server:
        yield server.url


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Return what opens the viewer; at the end no page may have logged an error or asked anyone else for anything."""
    pages: list[tuple[Any, str, list[str], list[str]]] = []

    def open_viewer(url: str, *, size: tuple[int, int] = (1280, 720), scheme: str = "dark", ready: bool = True) -> Any:
        page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
        errors: list[str] = []
        requests: list[str] = []
        page.on("console", lambda m: errors.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        pages.append((page, url, errors, requests))
        page.goto(url)
        if ready:
            page.wait_for_selector("html[data-ready]")
        return page

    yield open_viewer
    for page, url, errors, requests in pages:
        page.close()
        assert errors == []
        parts = urlsplit(url)
        origin = f"{parts.scheme}://{parts.netloc}/" if parts.netloc else url.split("#")[0]
        assert [r for r in requests if not r.startswith((origin, "data:"))] == []
