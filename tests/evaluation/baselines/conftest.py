"""An empty room and noise-free reports from it; nothing is built, for rivals need the scene and the stations only.

::

    y = 5 +-----------------+
          |             c o |      3 m high; four stations at different heights
          |     x UE        |
          |                 |
          | o d             |
          | o a           b |
    y = 0 +---------------o-+
        x = 0               4
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, TimeDifference, TimeOfArrival
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.geometry.angles import angles_of
from rayfix_tables.scene import Scene
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table

Array = NDArray[np.float64]

STATIONS = {"a": (0.5, 0.6, 2.6), "b": (3.6, 0.4, 1.3), "c": (3.2, 4.5, 2.7), "d": (0.4, 1.5, 0.3)}
UE = np.array([1.6, 3.4, 1.1])


def table_of(vertices: Array, faces: NDArray[np.int64]) -> Table:
    """Table without cells."""
    document = {"propagation": {"max_reflections": 2, "max_path_length_m": 30.0, "reflection_loss_db": 6.0}}
    return Table(
        path=Path("none.h5"),
        table_id="",
        format_version=0,
        software_version="",
        site=SiteInfo(
            name="room",
            north=0.0,
            max_path_length=30.0,
            stations=tuple(Station(id=name, position=place) for name, place in STATIONS.items()),
            document=document,
        ),
        scene=Scene(
            vertices=vertices,
            faces=faces.astype(np.int32),
            face_materials=np.zeros(len(faces), np.int16),
            materials=("none",),
            free_space=FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=np.ones((40, 50, 30), np.bool_)),
            sha256="",
        ),
        parts={},
    )


@pytest.fixture(scope="session")
def room() -> Table:
    """Return the empty room."""
    walls = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    return table_of(np.asarray(walls.vertices, np.float64), np.asarray(walls.faces, np.int64))


Measure = Callable[..., tuple[Measurement, ...]]


@pytest.fixture(scope="session")
def measure() -> Measure:
    """Noise-free measurements of the straight paths from a point."""

    def straight(kind: str, names: str = "abcd", point: Array = UE, clock: float = 123.0) -> tuple[Measurement, ...]:
        found: list[Measurement] = []
        first = float(np.linalg.norm(point - STATIONS[names[0]]))
        for name in names:
            length = float(np.linalg.norm(point - STATIONS[name]))
            azimuth, zenith = (float(v) for v in angles_of(point - STATIONS[name]))
            if kind == "aoa":
                found.append(
                    Angle(station_id=name, azimuth=azimuth, zenith=zenith, azimuth_stdev=0.01, zenith_stdev=0.02)
                )
            elif kind == "pt":
                found.append(Range(station_id=name, path_length=length, stdev=0.3))
            elif kind == "toa":
                found.append(TimeOfArrival(station_id=name, path_length=length + clock, stdev=0.3))
            elif name != names[0]:
                found.append(
                    TimeDifference(
                        station_id=name, reference_station_id=names[0], length_difference=length - first, stdev=0.4
                    )
                )
        return tuple(found)

    return straight
