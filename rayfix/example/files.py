"""Write the files of the bundled examples: the hall and the office."""

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rayfix.example.hall import hall_scene
from rayfix.example.office import office_scene
from rayfix_tables.errors import RayfixError

if TYPE_CHECKING:
    import trimesh

SCENE_FILE, SITE_FILE, REPORT_FILE = "hall.glb", "site.toml", "report.json"

Example = Literal["hall", "office"]

SCENES: dict[Example, "Callable[[], trimesh.Scene]"] = {"hall": hall_scene, "office": office_scene}

_FILES: dict[Example, tuple[str, str]] = {"hall": (SITE_FILE, REPORT_FILE), "office": ("office.toml", "office.json")}
"""Bundled files with the site and a report."""

_WINDOWS = "windows_deg = [1.25, 5, 15]"


def write_example(
    folder: str | Path, *, windows_deg: tuple[float, ...] = (1.25, 5.0, 15.0), example: Example = "hall"
) -> Path:
    """Write an example's scene, its site file and a report into a folder, which is created if needed.

    Returns
    -------
    Path
        The site file.

    Raises
    ------
    RayfixError
        When the folder cannot be written, or holds other files of these names, which are not overwritten.
    """
    folder = Path(folder)
    files = {
        folder / f"{example}.glb": SCENES[example]().export(file_type="glb"),
        folder / SITE_FILE: _site_text(windows_deg, example).encode(),
        folder / REPORT_FILE: example_report(example).encode(),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            if path.exists() and path.read_bytes() != content:
                raise RayfixError(f"{path} exists and is not from the example; choose another folder, or remove it")
        for path, content in files.items():
            path.write_bytes(content)
    except OSError as error:
        raise RayfixError(f"cannot write the example into {folder}: {error.strerror}; choose another folder") from error
    return folder / SITE_FILE


def example_report(example: Example = "hall") -> str:
    """JSON of a bundled report, as ``POST /v1/positions`` takes it."""
    return _bundled(_FILES[example][1])


def _bundled(name: str) -> str:
    return resources.files("rayfix.example").joinpath(name).read_text(encoding="utf-8")


def _site_text(windows_deg: tuple[float, ...], example: Example) -> str:
    text = _bundled(_FILES[example][0])
    assert text.count(_WINDOWS) == 1
    return text.replace(_WINDOWS, f"windows_deg = [{', '.join(f'{w:g}' for w in windows_deg)}]")
