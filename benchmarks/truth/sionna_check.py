"""The forward solver compared with Sionna RT: all paths of some stations to random points, in any scene.

``--office`` compares the bundled office, whose sheets let signals through, and paths that pass up to ``--max-walls``.
Needs the extra ``sionna`` and LLVM; see docs/evaluation.md.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.truth.scenes import ComparedScene, example_scene, mesh_scene, site_scene
from benchmarks.truth.sionna_rt import NOTHING_COMPARED, Physics, compare, shortest_segment, sionna_paths
from rayfix_evaluation.truth.forward import ForwardSolver

_NO_LIMIT = 1e4  # m; Sionna RT knows no longest path
_STATIONS = 4
_RANGE_DB = 30.0  # where walls let signals through, paths that are weaker than the strongest by more are not compared


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, help="a scene file; the bundled hall when left out")
    parser.add_argument("--site", type=Path, help="a site file, with its materials")
    parser.add_argument("--office", action="store_true", help="the bundled office, whose walls let signals through")
    parser.add_argument("--carrier-ghz", type=float, default=3.5)
    parser.add_argument("--points", type=int, default=10)
    parser.add_argument("--max-reflections", type=int, default=3)
    parser.add_argument("--max-walls", type=int, default=6, help="walls that a path passes in Sionna RT")
    parser.add_argument("--samples", type=int, default=1_000_000, help="rays that Sionna RT shoots from each point")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    scene = chosen_scene(options, rng)
    points = scene.points(options.points, rng)
    passes = scene.passes
    solver = ForwardSolver.from_mesh(
        scene.vertices,
        scene.faces,
        max_reflections=options.max_reflections,
        max_path_length=_NO_LIMIT,
        walls=scene.walls if passes else None,
        polarisation="kept",
    )
    solvers = [solver.station(place) for place in scene.stations]
    theirs = sionna_paths(
        scene.vertices,
        scene.faces,
        scene.stations,
        points,
        max_reflections=options.max_reflections,
        materials=scene.materials if passes else None,
        thickness=scene.thickness,
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


def chosen_scene(options: argparse.Namespace, rng: np.random.Generator) -> ComparedScene:
    """Make the scene of the command line's options."""
    if options.scene is not None:
        return mesh_scene(options.scene, _STATIONS, rng)
    if options.site is not None:
        return site_scene(options.site, carrier_ghz=options.carrier_ghz)
    return example_scene("office" if options.office else "hall", carrier_ghz=options.carrier_ghz)


if __name__ == "__main__":
    main()
