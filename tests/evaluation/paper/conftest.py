"""An empty room, its table with the paper's prior, and a transmitter in it.

::

    y = 5 +-----------------+
          |             c o |      3 m high; stations near the ceiling, the transmitter at 1.1 m
          |     x UE        |
          |                 |
          |                 |
          | o a           b |
    y = 0 +---------------o-+
        x = 0               4
"""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from rayfix_offline.build import build_table
from rayfix_tables.table import Table
from tests.support.scenes.sites import stations_text

STATIONS = {"a": (0.5, 0.6, 2.6), "b": (3.6, 0.4, 2.3), "c": (3.2, 4.5, 2.7)}
UE = np.array([1.6, 3.4, 1.1])


@pytest.fixture(scope="session")
def room_table(tmp_path_factory: pytest.TempPathFactory) -> Table:
    """Table of the room: one reflection, and points along a ray all alike as in the paper."""
    folder: Path = tmp_path_factory.mktemp("paper")
    walls = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    walls.invert()
    (folder / "room.glb").write_bytes(trimesh.Scene(walls).export(file_type="glb"))
    (folder / "site.toml").write_text(
        '[site]\nname = "room"\nscene = "room.glb"\n'
        '[propagation]\nmax_reflections = 1\nmax_path_length_m = 12.0\npath_prior = "paper"\n'
        f"[table]\nwindows_deg = [2.5]\n{stations_text(STATIONS)}",
        encoding="utf-8",
    )
    build_table(folder / "site.toml", folder / "room.h5")
    return Table.open(folder / "room.h5")
