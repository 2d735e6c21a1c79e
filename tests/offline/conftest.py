"""Small scenes, and rays launched in them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike, NDArray

from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.segments import Segments
from rayfix_offline.scene.engine import EmbreeEngine
from rayfix_offline.scene.walls import Walls, opaque_walls
from rayfix_offline.twin.planes import merge_coplanar
from tests.support.oracles.rays import Rows
from tests.support.scenes.rooms import CABINET, ROOM, TABLE, scene_of_boxes
from tests.support.scenes.shapes import box


@pytest.fixture(scope="session")
def room() -> NDArray[np.float64]:
    """Triangles of the empty room, 4 x 5 x 3 m."""
    return box(*ROOM)


@pytest.fixture(scope="session")
def clutter() -> NDArray[np.float64]:
    """Triangles of the room with its cabinet and its table top."""
    return np.concatenate([box(*ROOM), box(*CABINET), box(*TABLE)])


@pytest.fixture(scope="session")
def launch_in() -> Callable[..., Segments]:
    """Return a function that launches rays among triangles."""

    def run(
        triangles: NDArray[np.float64],
        station: ArrayLike,
        directions: NDArray[np.float64],
        *,
        max_reflections: int = 3,
        max_path_length: float = 1000.0,
        loss_db: float = 6.0,
        walls: Walls | None = None,
    ) -> Segments:
        corners = triangles.reshape(-1, 3)
        return launch(
            np.asarray(station, dtype=np.float64),
            directions,
            engine=EmbreeEngine(triangles),
            planes=merge_coplanar(triangles),
            walls=walls or opaque_walls(len(triangles), loss_db=loss_db),
            bounds=np.stack([corners.min(axis=0), corners.max(axis=0)]),
            max_reflections=max_reflections,
            max_path_length=max_path_length,
        )

    return run


@pytest.fixture(scope="session")
def launch_rows(launch_in: Callable[..., Segments]) -> Callable[..., Rows]:
    """Return a function that launches rays among opaque triangles, one row for each."""

    def run(*args: Any, **options: Any) -> Rows:
        return Rows.of(launch_in(*args, **options))

    return run


@pytest.fixture(scope="session")
def unit_vectors() -> Callable[[int, int], NDArray[np.float64]]:
    """Return a function that draws isotropic directions, shape (count, 3)."""

    def draw(count: int, seed: int) -> NDArray[np.float64]:
        vectors = np.random.default_rng(seed).normal(size=(count, 3))
        return vectors / np.linalg.norm(vectors, axis=1)[:, None]

    return draw


def room_scene() -> trimesh.Scene:
    """Give the room with its cabinet and its table as named objects; the room's triangles face inwards."""
    scene = scene_of_boxes(room=ROOM, cabinet=CABINET, table=TABLE)
    scene.geometry["room"].invert()
    return scene


@pytest.fixture
def cluttered_scene() -> trimesh.Scene:
    """Return the room with its cabinet and its table, for the test to change."""
    return room_scene()


@pytest.fixture(scope="session")
def site_document() -> Callable[..., dict[str, Any]]:
    """Return a function that gives a site file's content; sections are updated by what is passed."""

    def make(**sections: Any) -> dict[str, Any]:
        document: dict[str, Any] = {
            "site": {"name": "room", "scene": "room.glb"},
            "propagation": {"max_reflections": 1, "max_path_length_m": 30.0},
            "table": {"windows_deg": [10.0]},
            "stations": [{"id": "bs1", "position_m": [3.6, 0.4, 2.6]}],
        }
        for name, section in sections.items():
            document[name] = {**document.get(name, {}), **section} if isinstance(section, dict) else section
        return document

    return make


def as_toml(document: dict[str, Any]) -> str:
    """Write a site document as TOML; its strings, numbers and lists look alike in both."""

    def entries(section: dict[str, Any]) -> str:
        return "".join(
            f"{key} = {str(value).lower() if isinstance(value, bool) else repr(value)}\n"
            for key, value in section.items()
        )

    text = "".join(f"[{name}]\n{entries(document[name])}" for name in ("site", "propagation", "table"))
    text += "".join(f"[materials.{name}]\n{entries(each)}" for name, each in document.get("materials", {}).items())
    return text + "".join(f"[[stations]]\n{entries(station)}" for station in document["stations"])


@pytest.fixture(scope="session")
def write_site(site_document: Callable[..., dict[str, Any]]) -> Callable[..., Path]:
    """Return a function that writes the cluttered room and its site file into a folder."""

    def write(folder: Path, *, scene: trimesh.Scene | None = None, **sections: Any) -> Path:
        (folder / "room.glb").write_bytes((scene or room_scene()).export(file_type="glb"))
        path = folder / "site.toml"
        path.write_text(as_toml(site_document(**sections)), encoding="utf-8")
        return path

    return write
