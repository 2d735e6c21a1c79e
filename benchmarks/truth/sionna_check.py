"""The forward solver compared with Sionna RT: all paths of some stations to random points, in any scene.

``--office`` compares an office of sheets that let signals through, whose paths pass up to ``--max-walls`` of them.
Needs the extra ``sionna`` and LLVM; see docs/evaluation.md.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.truth.office import STATIONS, THICKNESS, office_sheets
from benchmarks.truth.sionna_rt import NOTHING_COMPARED, Physics, compare, shortest_segment, sionna_paths
from rayfix.example.hall import hall_scene, hall_stations
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_evaluation.truth.walls import Walls
from rayfix_offline.scene.materials import complex_permittivity
from rayfix_offline.scene.scene import load_scene

_NO_LIMIT = 1e4  # m; Sionna RT knows no longest path
_STATIONS = 4
_RANGE_DB = 30.0  # paths of an office that are weaker than the strongest by more are not compared


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """A scene in which paths are compared: its mesh, stations, and materials if signals pass through its sheets."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    stations: NDArray[np.float64]
    materials: tuple[str, ...] | None = None

    def walls(self, carrier_ghz: float) -> Walls | None:
        """Sheets of the materials; without their excess length, which Sionna RT leaves out."""
        if self.materials is None:
            return None
        known = {name: complex_permittivity(name, carrier_ghz) for name in set(self.materials)}
        permittivity = np.array([np.nan if known[name] is None else known[name] for name in self.materials])
        thickness = np.array([np.nan if name == "metal" else THICKNESS[name] for name in self.materials])
        return replace(Walls.sheets(permittivity, thickness, carrier_ghz=carrier_ghz), excess_length=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, help="a scene file; the bundled hall when left out")
    parser.add_argument("--office", action="store_true", help="an office whose walls let signals through")
    parser.add_argument("--carrier-ghz", type=float, default=3.5)
    parser.add_argument("--points", type=int, default=10)
    parser.add_argument("--max-reflections", type=int, default=3)
    parser.add_argument("--max-walls", type=int, default=6, help="walls that a path passes in Sionna RT")
    parser.add_argument("--samples", type=int, default=1_000_000, help="rays that Sionna RT shoots from each point")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    scene = chosen_scene(options.scene, office=options.office, rng=rng)
    points = within(scene.vertices, options.points, rng)
    passes = scene.materials is not None
    solver = ForwardSolver.from_mesh(
        scene.vertices,
        scene.faces,
        max_reflections=options.max_reflections,
        max_path_length=_NO_LIMIT,
        walls=scene.walls(options.carrier_ghz),
        polarisation="kept",
    )
    solvers = [solver.station(place) for place in scene.stations]
    theirs = sionna_paths(
        scene.vertices,
        scene.faces,
        scene.stations,
        points,
        max_reflections=options.max_reflections,
        materials=scene.materials,
        thickness=THICKNESS if passes else None,
        physics=Physics(
            carrier_ghz=options.carrier_ghz,
            refraction=passes,
            max_interactions=options.max_reflections + (options.max_walls if passes else 0),
        ),
        samples=options.samples,
    )
    total = NOTHING_COMPARED
    many_walls = 0
    for point, by_station in zip(points, theirs, strict=True):
        for station, found in zip(solvers, by_station, strict=True):
            ours = station.paths(point)
            within_depth = ours.num_walls + ours.num_reflections <= options.max_reflections + options.max_walls
            many_walls += int((~within_depth & (ours.gain_db >= ours.gain_db.max(initial=-np.inf) - _RANGE_DB)).sum())
            pair = compare(ours.chosen(within_depth), found, range_db=_RANGE_DB if passes else np.inf)
            total += pair
            if pair.only_theirs or (pair.only_ours and not passes):
                segments = [round(shortest_segment(ours, i), 4) for i in range(len(ours))]
                print(
                    f"{station.position} to {point.round(3)}: {pair.only_ours} only here, {pair.only_theirs} only "
                    f"there; lengths here {ours.path_length.round(4).tolist()}, "
                    f"there {found.path_length.round(4).tolist()}, shortest segments here {segments}"
                )
    print(
        f"{len(points)} points, {len(scene.stations)} stations, up to {options.max_reflections} reflections: "
        f"{total.num_common} paths of both, lengths within {1e3 * total.largest_length:.4f} mm and directions within "
        f"{np.degrees(total.largest_angle):.5f} deg; {total.short_segments} left out there for a segment below 1 cm, "
        f"{total.only_ours} others only here, {total.only_theirs} only there"
    )
    if passes:
        apart = np.abs(np.array(total.gains_apart))
        quantiles = ", ".join(f"{share:.1%} within {np.quantile(apart, share):.3f} dB" for share in (0.5, 0.99, 1.0))
        print(
            f"paths down to {_RANGE_DB:g} dB below the strongest at {options.carrier_ghz:g} GHz: gains {quantiles}; "
            f"{total.share_within(0.1):.2%} within 0.1 dB; {many_walls} with more interactions than Sionna RT follows"
        )


def chosen_scene(path: Path | None, *, office: bool, rng: np.random.Generator) -> Compared:
    """Make the scene of the command line's options: a file, the office, or the bundled hall."""
    if office:
        sheets = office_sheets()
        return Compared(vertices=sheets.vertices, faces=sheets.faces, stations=STATIONS, materials=sheets.materials)
    if path is not None:
        scene = load_scene(path)
        stations = within(scene.vertices, _STATIONS, rng)
        return Compared(vertices=scene.vertices, faces=scene.faces.astype(np.int64), stations=stations)
    mesh = hall_scene().to_geometry()
    return Compared(
        vertices=np.asarray(mesh.vertices, np.float64),
        faces=np.asarray(mesh.faces, np.int64),
        stations=np.array([place for _, place in hall_stations()]),
    )


def within(vertices: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Points drawn evenly from the box of a scene, which may lie within solids: there are then no paths."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return rng.uniform(low + 0.05 * (high - low), high - 0.05 * (high - low), (count, 3))


if __name__ == "__main__":
    main()
