"""A small room with its site file, and an evaluation of it."""

from pathlib import Path

import pytest
import trimesh

from tests.support.scenes.sites import stations_text

_SITE = """
[site]
name = "room"
scene = "room.glb"
[propagation]
max_reflections = 1
max_path_length_m = 12.0
[table]
windows_deg = [6.0, 20.0]
"""

_STATIONS = {"a": (0.2, 0.2, 2.6), "b": (4.8, 0.2, 2.6), "c": (4.8, 3.8, 2.6)}


@pytest.fixture(scope="session")
def room_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a room of 5 x 4 x 2.8 m, three stations under its ceiling and a cupboard in its middle."""
    folder = tmp_path_factory.mktemp("room")
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(bounds=[(0, 0, 0), (5, 4, 2.8)]), geom_name="shell")
    scene.add_geometry(trimesh.creation.box(bounds=[(2.2, 1.0, 0), (2.8, 2.6, 2.0)]), geom_name="cupboard")
    (folder / "room.glb").write_bytes(scene.export(file_type="glb"))
    site = folder / "site.toml"
    site.write_text(_SITE + stations_text(_STATIONS), encoding="utf-8")
    return site
