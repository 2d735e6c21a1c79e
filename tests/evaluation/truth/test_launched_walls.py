"""Launched rays and the image method pass the same walls with the same losses and lengths, in the bundled office."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix.example.files import write_example
from rayfix_evaluation.truth.forward import ForwardSolver, Paths
from rayfix_evaluation.truth.scene_walls import walls_of_twin
from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.segments import Segments
from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.rays.trace import scene_walls
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import Twin, prepare_twin
from rayfix_tables.geometry.angles import direction

Array = NDArray[np.float64]
SETTINGS = RaySettings()


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> Twin:
    folder: Path = tmp_path_factory.mktemp("office")
    return prepare_twin(read_site(write_example(folder, example="office")), folder)


def launched(twin: Twin, station: Array, headings: Array) -> Segments:
    return launch(
        station,
        headings,
        engine=twin.engine,
        planes=twin.planes,
        walls=scene_walls(twin.site, twin),
        bounds=np.stack(twin.scene.bounds),
        max_reflections=2,
        max_path_length=60.0,
    )


def piece_of(segments: Segments, paths: Paths, i: int, heading: Array) -> int | None:
    """Piece of ray i that is reflected where the path is, and passes the path's end at the path's length."""
    length = np.linalg.norm(np.diff(paths.vertices[i], axis=0), axis=1).sum()
    for n in range(segments.offsets[i], segments.offsets[i + 1]):
        sequence = segments.sequence[n]
        if segments.sequences.num_reflections[sequence] != paths.num_reflections[i]:
            continue
        if not segments.start[n] - 1e-3 <= length <= segments.end[n] + 1e-3:
            continue
        place = segments.sequences.images[sequence] + length * (segments.sequences.mirrors[sequence] @ heading)
        if np.linalg.norm(place - paths.vertices[i, -1]) < 1e-3 and bounces_alike(segments, n, paths, i, heading):
            return n
    return None


def bounces_alike(segments: Segments, n: int, paths: Paths, i: int, heading: Array) -> bool:
    """Whether a piece comes from reflections where the path has them."""
    sequences = segments.sequences
    along = np.cumsum(np.linalg.norm(np.diff(paths.vertices[i], axis=0), axis=1))
    sequence = segments.sequence[n]
    for bounce in range(int(paths.num_reflections[i]), 0, -1):
        parent = sequences.parents[sequence]
        place = sequences.images[parent] + along[bounce - 1] * (sequences.mirrors[parent] @ heading)
        mirrored = sequences.images[sequence] + along[bounce - 1] * (sequences.mirrors[sequence] @ heading)
        if np.linalg.norm(place - mirrored) > 1e-3 or np.linalg.norm(place - paths.vertices[i, bounce]) > 1e-3:
            return False
        sequence = parent
    return True


def test_every_path_of_the_office_is_launched_alike(office: Twin) -> None:
    """Those that the launcher does not cut off; a ray along the path's first direction must hold its last piece."""
    solver = ForwardSolver.from_mesh(
        office.scene.vertices,
        office.scene.faces,
        max_reflections=2,
        walls=walls_of_twin(office),
        max_loss_db=SETTINGS.mirrored_floor_db - 0.01,
    )
    rng = np.random.default_rng(7)
    compared, walls, missing = 0, 0, 0
    for station in office.site.stations[:3]:
        of_station = solver.station(np.array(station.position_m))
        for point in rng.uniform((0.3, 0.3, 0.3), (19.7, 13.7, 2.5), (6, 3)):
            paths = of_station.paths(point)
            paths = paths.chosen(paths.num_walls <= SETTINGS.max_walls)
            if not len(paths):
                continue
            headings = direction(paths.azimuth, paths.zenith)
            segments = launched(office, of_station.position, headings)
            for i in range(len(paths)):
                n = piece_of(segments, paths, i, headings[i])
                if n is None:
                    missing += 1
                    continue
                length = np.linalg.norm(np.diff(paths.vertices[i], axis=0), axis=1).sum()
                assert segments.num_walls[n] == paths.num_walls[i]
                assert 10 * segments.log_gain[n] - 20 * np.log10(length) == pytest.approx(paths.gain_db[i], abs=1e-3)
                assert length + segments.excess[n] == pytest.approx(paths.path_length[i], abs=1e-5)
                compared += 1
                walls += paths.num_walls[i]
    assert compared > 300
    assert walls > 500
    # A ray in single precision that grazes an edge may pass on its other side.
    assert missing <= 0.01 * compared
