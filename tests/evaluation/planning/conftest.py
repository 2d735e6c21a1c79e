"""A room with a screen in it, and its table of straight paths.

::

    y = 5 +--------------------+
          |                o c |      3 m high; the screen reaches from floor to ceiling
          |                    |      and is 0.2 m thick
          |        ##          |
          |        ##          |
          | o a    ##       o b|
    y = 0 +--------##----------+
        x = 0     2            4
"""

from pathlib import Path

import pytest
import trimesh

from rayfix_offline.build import build_table
from rayfix_tables.table import Table
from tests.support.scenes.sites import stations_text

STATIONS = {"a": (0.5, 0.6, 2.6), "b": (3.6, 0.4, 2.3), "c": (3.2, 4.5, 2.7)}


def build_room(folder: Path, names: str) -> Path:
    """Build the table of the room with some of the stations."""
    walls = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    walls.invert()
    screen = trimesh.creation.box(bounds=[(1.9, 0, 0), (2.1, 3.5, 3)])
    (folder / "room.glb").write_bytes(trimesh.Scene([walls, screen]).export(file_type="glb"))
    (folder / "site.toml").write_text(
        '[site]\nname = "room"\nscene = "room.glb"\n'
        "[propagation]\nmax_reflections = 0\nmax_path_length_m = 12.0\n"
        f"[table]\nwindows_deg = [2.5]\n{stations_text({name: STATIONS[name] for name in names})}",
        encoding="utf-8",
    )
    table = folder / f"{names}.h5"
    build_table(folder / "site.toml", table)
    return table


@pytest.fixture(scope="session")
def screen_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Table with all three stations."""
    return build_room(tmp_path_factory.mktemp("screen"), "abc")


@pytest.fixture(scope="session")
def screen_table(screen_path: Path) -> Table:
    """Table with all three stations."""
    return Table.open(screen_path)


@pytest.fixture(scope="session")
def fewer_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Table without station c."""
    return build_room(tmp_path_factory.mktemp("fewer"), "ab")
