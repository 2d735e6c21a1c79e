"""The forward solver compared with Sionna RT: all paths of some stations to random points, in any scene.

Needs the extra ``sionna`` and LLVM; see docs/evaluation.md.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.truth.sionna_rt import NOTHING_COMPARED, compare, shortest_segment, sionna_paths
from rayfix.example.hall import hall_scene, hall_stations
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_offline.scene.scene import load_scene

_NO_LIMIT = 1e4  # m; Sionna RT knows no longest path
_STATIONS = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, help="a scene file; the bundled hall when left out")
    parser.add_argument("--points", type=int, default=10)
    parser.add_argument("--max-reflections", type=int, default=3)
    parser.add_argument("--samples", type=int, default=1_000_000, help="rays that Sionna RT shoots from each point")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    if options.scene is None:
        mesh = hall_scene().to_geometry()
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        stations = np.array([place for _, place in hall_stations()])
    else:
        scene = load_scene(options.scene)
        vertices, faces = scene.vertices, scene.faces.astype(np.int64)
        stations = within(vertices, _STATIONS, rng)
    points = within(vertices, options.points, rng)
    solver = ForwardSolver.from_mesh(
        vertices, faces, max_reflections=options.max_reflections, max_path_length=_NO_LIMIT
    )
    solvers = [solver.station(place) for place in stations]
    theirs = sionna_paths(
        vertices, faces, stations, points, max_reflections=options.max_reflections, samples=options.samples
    )
    total = NOTHING_COMPARED
    for point, by_station in zip(points, theirs, strict=True):
        for station, found in zip(solvers, by_station, strict=True):
            ours = station.paths(point)
            pair = compare(ours, found)
            total += pair
            if pair.only_ours or pair.only_theirs:
                segments = [round(shortest_segment(ours, i), 4) for i in range(len(ours))]
                print(
                    f"{station.position} to {point.round(3)}: {pair.only_ours} only here, {pair.only_theirs} only "
                    f"there; lengths here {ours.path_length.round(4).tolist()}, "
                    f"there {found.path_length.round(4).tolist()}, shortest segments here {segments}"
                )
    print(
        f"{len(points)} points, {len(stations)} stations, up to {options.max_reflections} reflections: "
        f"{total.num_common} paths of both, lengths within {1e3 * total.largest_length:.4f} mm and directions within "
        f"{np.degrees(total.largest_angle):.5f} deg; {total.short_segments} left out there for a segment below 1 cm, "
        f"{total.only_ours} others only here, {total.only_theirs} only there"
    )


def within(vertices: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Points drawn evenly from the box of a scene, which may lie within solids: there are then no paths."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return rng.uniform(low + 0.05 * (high - low), high - 0.05 * (high - low), (count, 3))


if __name__ == "__main__":
    main()
