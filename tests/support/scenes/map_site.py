"""A small site, next to the origin or anywhere on a map, and a report of a UE in it."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from tests.support.scenes.sites import stations_text

Array = NDArray[np.float64]

SHIFT = np.array([500_000.0, 5_400_000.0, 300.0])
UE = np.array([5.1, 6.2, 1.3])
POSITIONS = {"a": (0.3, 0.4, 2.6), "b": (7.6, 0.3, 2.5), "c": (7.7, 9.6, 2.6)}


def write_site(folder: Path, shift: Array) -> Path:
    """Write the site moved by a vector; its scene as text, in double precision."""
    room = trimesh.creation.box(bounds=[(0, 0, 0), (8, 10, 3)])
    room.invert()
    pillar = trimesh.creation.box(bounds=[(2, 3, 0), (3, 4, 2.2)])
    lines, count = [], 1
    for name, mesh in (("room", room), ("pillar", pillar)):
        lines += [f"o {name}", *(f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices + shift)]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + count]
        count += len(mesh.vertices)
    folder.mkdir()
    (folder / "room.obj").write_text("\n".join(lines))
    path = folder / "site.toml"
    path.write_text(
        '[site]\nname = "room"\nscene = "room.obj"\n[propagation]\nmax_reflections = 1\nmax_path_length_m = 40\n'
        "[table]\nwindows_deg = [7.5, 15]\n"
        + stations_text({name: tuple((np.array(p) + shift).round(4).tolist()) for name, p in POSITIONS.items()})
    )
    return path


def report(ue: Array = UE, *, height: float | None = None, **more: Any) -> dict[str, Any]:
    """Return what the stations measure of the UE, which is the same here and there."""
    measurements: list[dict[str, Any]] = []
    for name, position in POSITIONS.items():
        apart = ue - position
        length = float(np.linalg.norm(apart))
        measurements += [
            {
                "type": "aoa",
                "station_id": name,
                "azimuth_deg": float(np.rad2deg(np.arctan2(apart[1], apart[0]))),
                "zenith_deg": float(np.rad2deg(np.arccos(apart[2] / length))),
                "azimuth_stdev_deg": 1.5,
                "zenith_stdev_deg": 1.5,
            },
            {"type": "pt", "station_id": name, "range_m": length, "stdev_m": 0.2},
        ]
    known = {} if height is None else {"height": {"z_m": height, "stdev_m": 0.05}}
    return {"measurements": measurements, **known, **more}
