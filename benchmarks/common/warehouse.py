"""The warehouse of the studies: a real scene outside of the repository, with six stations."""

from pathlib import Path

import tomli_w

WAREHOUSE_SCENE = Path(__file__).parents[3] / "shared" / "data" / "warehouse" / "warehouse_collision.ply"

WAREHOUSE_STATIONS = {
    "w1": (-4.5, -9.0, 4.5),
    "w2": (5.5, -9.5, 4.8),
    "w3": (6.0, 0.5, 4.2),
    "w4": (6.0, 9.5, 4.6),
    "w5": (-3.8, 9.3, 5.0),
    "w6": (-3.5, 0.5, 4.0),
}


def write_warehouse(folder: Path) -> Path | None:
    """Write the warehouse's site file; None where its scene is missing."""
    if not WAREHOUSE_SCENE.exists():
        return None
    document = {
        "site": {"name": "warehouse", "scene": str(WAREHOUSE_SCENE.resolve())},
        "stations": [{"id": name, "position_m": list(position)} for name, position in WAREHOUSE_STATIONS.items()],
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "site.toml"
    path.write_text(tomli_w.dumps(document), encoding="utf-8")
    return path
