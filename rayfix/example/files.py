"""Write the bundled example as the files that a user would start from."""

import math
from importlib import resources
from pathlib import Path

from rayfix.example.hall import hall_scene, hall_stations
from rayfix_tables.errors import RayfixError

SCENE_FILE, SITE_FILE, REPORT_FILE = "hall.glb", "site.toml", "report.json"

_SITE = """\
# The bundled example hall. docs/conventions.md explains frames and units.

[site]
name = "hall"
scene = "{scene}"             # glb, gltf, obj, ply, stl, dae or Mitsuba XML, relative to this file
scene_unit = "m"              # applied when the scene file does not say
scene_up = "z"                # "y" for glTF as most tools export it
north_deg = 90.0              # azimuth of geographic north in the scene frame

[propagation]
carrier_ghz = 3.5
max_reflections = 3
max_path_length_m = 60.0
reflection = "constant"       # "constant", or "itu": by the ITU-R P.2040 names of the mesh's materials
reflection_loss_db = 6.0      # of each reflection; with "itu", of materials without such a name
path_prior = "power"          # which path a station reports: "power", "uniform" or "paper"
path_prior_exponent = 2.0     # how much the strong ones are preferred

[table]
windows_deg = [{windows}]
fit = "tubes"                 # "tubes" (fast) or "em" (the paper's)
seed = 1

# A station's bias is what it measures wrongly each time (measured minus true) and how well that is known.
{stations}"""

_STATION = """
[[stations]]
id = "{id}"
position_m = [{position}]
orientation_deg = [{bearing:g}, 0, 0]  # bearing, downtilt, slant; for angles in frame "lcs"
field_of_view_deg = 360
bias = {{ range_m = 0.0, range_stdev_m = 0.0, azimuth_deg = 0.0, zenith_deg = 0.0, angle_stdev_deg = 0.0 }}
"""


def write_example(folder: str | Path, *, windows_deg: tuple[float, ...] = (1.25, 5.0, 15.0)) -> Path:
    """Write the hall's scene, its site file and a report into a folder, which is made when it is not there.

    Returns
    -------
    Path
        The site file.

    Raises
    ------
    RayfixError
        When the folder cannot be written, or has other files of these names: they may hold somebody's work.
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
                raise RayfixError(
                    f"{path} is there and is not the example's; choose another folder, or remove it first"
                )
        for path, content in files.items():
            path.write_bytes(content)
    except OSError as error:
        raise RayfixError(f"cannot write the example into {folder}: {error.strerror}; choose another folder") from error
    return folder / SITE_FILE


def example_report() -> str:
    """JSON of the bundled report, as ``POST /v1/positions`` takes it."""
    return resources.files("rayfix.example").joinpath(REPORT_FILE).read_text(encoding="utf-8")


def _site_text(windows_deg: tuple[float, ...]) -> str:
    stations = "".join(
        _STATION.format(id=name, position=", ".join(f"{v:g}" for v in position), bearing=_towards_middle(position))
        for name, position in hall_stations()
    )
    return _SITE.format(scene=SCENE_FILE, windows=", ".join(f"{w:g}" for w in windows_deg), stations=stations)


def _towards_middle(position: tuple[float, float, float]) -> float:
    """Bearing of a corner station that looks diagonally into the hall, degrees."""
    x, y, _ = position
    return math.degrees(math.atan2(1.0 if y < 9.0 else -1.0, 1.0 if x < 4.0 else -1.0))
