"""Write the files of the bundled example."""

from importlib import resources
from pathlib import Path

from rayfix.example.hall import hall_scene
from rayfix_tables.errors import RayfixError

SCENE_FILE, SITE_FILE, REPORT_FILE = "hall.glb", "site.toml", "report.json"

_WINDOWS = "windows_deg = [1.25, 5, 15]"


def write_example(folder: str | Path, *, windows_deg: tuple[float, ...] = (1.25, 5.0, 15.0)) -> Path:
    """Write the hall's scene, its site file and a report into a folder, which is created if needed.

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
        folder / SCENE_FILE: hall_scene().export(file_type="glb"),
        folder / SITE_FILE: _site_text(windows_deg).encode(),
        folder / REPORT_FILE: example_report().encode(),
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


def example_report() -> str:
    """JSON of the bundled report, as ``POST /v1/positions`` takes it."""
    return resources.files("rayfix.example").joinpath(REPORT_FILE).read_text(encoding="utf-8")


def _site_text(windows_deg: tuple[float, ...]) -> str:
    text = resources.files("rayfix.example").joinpath(SITE_FILE).read_text(encoding="utf-8")
    assert text.count(_WINDOWS) == 1
    return text.replace(_WINDOWS, f"windows_deg = [{', '.join(f'{w:g}' for w in windows_deg)}]")
