"""Paths that bend once round an edge, compared with Sionna RT in the bundled office or the site of a file.

Sionna RT takes the sheets of one material for one mesh, which knows nothing of the others: a pane has free edges all
round in the wall that holds it. The solver is therefore given edges by material. Where a wall follows the edge, Sionna
RT's gain is up to 8 dB smaller than with the ends exchanged, and gains are not compared. Needs the extra ``sionna`` and
LLVM; see docs/evaluation.md.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.truth.scenes import example_scene, site_scene
from benchmarks.truth.sionna_rt import FoundPaths, Physics, sionna_paths
from rayfix_evaluation.truth.diffraction import DiffractedPaths, diffracted_paths
from rayfix_evaluation.truth.edges import find_edges
from rayfix_evaluation.truth.images import mirror_scene
from rayfix_tables.geometry.angles import direction

_RANGE_DB = 30.0
_LENGTH, _ANGLE = 1e-3, 1e-3  # m and rad, differences of one path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--site", type=Path, help="a site file; the bundled office when left out")
    parser.add_argument("--carrier-ghz", type=float, default=3.5)
    parser.add_argument("--points", type=int, default=10)
    parser.add_argument("--max-walls", type=int, default=4)
    parser.add_argument("--samples", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    carrier = options.carrier_ghz
    scene = (
        site_scene(options.site, carrier_ghz=carrier) if options.site else example_scene("office", carrier_ghz=carrier)
    )
    assert scene.walls is not None
    assert scene.materials is not None
    mirrors = mirror_scene(scene.vertices, scene.faces, scene.walls)
    walls = scene.walls.of_faces(mirrors.triangle_faces)
    corners = scene.vertices[scene.faces][mirrors.triangle_faces]
    parts = np.unique(np.array(scene.materials)[mirrors.triangle_faces], return_inverse=True)[1].astype(np.int64)
    edges = find_edges(mirrors, corners, parts)
    points = scene.points(options.points, np.random.default_rng(options.seed))
    lengths: list[float] = []
    gains: list[float] = []
    only_there, behind, told = 0, 0, 0
    theirs = sionna_paths(
        scene.vertices,
        scene.faces,
        scene.stations,
        points,
        max_reflections=1,
        materials=scene.materials,
        thickness=scene.thickness,
        physics=Physics(carrier_ghz=carrier, refraction=True, diffraction=True, max_interactions=1 + options.max_walls),
        samples=options.samples,
        from_stations=True,
    )
    for point, by_station in zip(points, theirs, strict=True):
        for station, found in zip(scene.stations, by_station, strict=True):
            ours = diffracted_paths(mirrors, walls, edges, station, point)
            strong = found.gain_db >= found.gain_db.max(initial=-np.inf) - _RANGE_DB
            bent = found.chosen(strong & (found.others == 1) & (found.num_reflections == 0))
            told += len(bent)
            pairs = matched(ours, bent)
            only_there += len(bent) - len(pairs)
            for i, j in pairs:
                lengths.append(abs(float(ours.path_length[i] - bent.path_length[j])))
                if ours.num_walls[i, 1]:
                    behind += 1
                else:
                    gains.append(float(ours.gain_db[i] - bent.gain_db[j]))
    apart = np.abs(gains)
    print(
        f"{len(points)} points, {len(scene.stations)} stations, {carrier:g} GHz, {len(edges.length)} edges: {told} "
        f"diffracted paths there, {only_there} of them only there; lengths within {1e3 * max(lengths):.4f} mm\n"
        f"gains of {len(gains)} paths without a wall behind the edge: 50 % within {np.quantile(apart, 0.5):.3f} dB, "
        f"99 % within {np.quantile(apart, 0.99):.2f} dB, {np.mean(apart <= 1.0):.1%} within 1 dB; "
        f"{behind} others have a wall behind the edge"
    )


def matched(ours: DiffractedPaths, theirs: FoundPaths) -> list[tuple[int, int]]:
    """Pairs of paths of one length and direction; of those that are alike, the ones with the nearest gains."""
    headings = direction(ours.azimuth, ours.zenith)
    left = set(range(len(ours)))
    pairs = []
    for j in range(len(theirs)):
        apart = np.abs(ours.path_length - theirs.path_length[j]) / _LENGTH
        apart = np.maximum(apart, np.linalg.norm(headings - theirs.direction[j], axis=1) / _ANGLE)
        alike = [i for i in np.flatnonzero(apart <= 1.0).tolist() if i in left]
        if alike:
            best = min(alike, key=lambda i: abs(float(ours.gain_db[i] - theirs.gain_db[j])))
            left.remove(best)
            pairs.append((best, j))
    return pairs


if __name__ == "__main__":
    main()
