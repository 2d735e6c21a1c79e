"""Drops in a site whose paths Sionna RT finds, with all its mechanisms, written into a file.

Reflection, refraction, diffraction, and what scattering takes from reflections. More rays or more drops at a time find
more candidates than Sionna RT keeps, and it then misses some of the strongest paths. Needs the extra ``sionna`` and
LLVM; see docs/evaluation.md. ``benchmarks.truth.sionna_reports`` makes reports of the drops.
"""

import argparse
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.truth.scenes import ComparedScene, example_scene, site_scene
from benchmarks.truth.sionna_rt import FoundPaths, Physics, sionna_paths

_MARGIN = 0.06  # m, smallest distance of a drop from solids along each axis
_KEPT = 30  # strongest paths of a link that are written


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--site", type=Path, help="a site file; a bundled example when left out")
    parser.add_argument("--example", choices=["office", "hall"], default="office")
    parser.add_argument("--drops", type=int, default=300)
    parser.add_argument("--max-reflections", type=int, default=3, help="reflections, diffractions and scatterings")
    parser.add_argument("--max-walls", type=int, default=5, help="walls that a path passes beside these")
    parser.add_argument("--scattering", type=float, default=0.3, help="scattered share of the reflected amplitude")
    parser.add_argument("--no-diffraction", action="store_true")
    parser.add_argument("--no-refraction", action="store_true", help="no path passes a wall")
    parser.add_argument("--samples", type=int, default=50_000, help="rays that are shot from each station")
    parser.add_argument("--batch", type=int, default=10, help="drops at a time, which bounds the memory")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("-o", "--output", type=Path, required=True, help="the file, .npz")
    options = parser.parse_args()
    scene = site_scene(options.site) if options.site else example_scene(options.example)
    assert scene.walls is not None
    points = clear_points(scene, options.drops, np.random.default_rng([options.seed, 0]))
    physics = Physics(
        carrier_ghz=scene.walls.carrier_ghz,
        refraction=not options.no_refraction,
        max_interactions=options.max_reflections + options.max_walls,
        diffraction=not options.no_diffraction,
        scattering=options.scattering,
    )
    begin = perf_counter()
    found: list[list[FoundPaths]] = []
    for first in range(0, len(points), options.batch):
        batch = points[first : first + options.batch]
        found += sionna_paths(
            scene.vertices,
            scene.faces,
            scene.stations,
            batch,
            max_reflections=options.max_reflections,
            materials=scene.materials,
            thickness=scene.thickness,
            physics=physics,
            samples=options.samples,
            from_stations=True,
        )
        print(f"{len(found)} of {len(points)} drops, {perf_counter() - begin:.0f} s", flush=True)
        write_drops(options.output, points[: len(found)], found)


def clear_points(scene: ComparedScene, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw points in the free space with a margin, shape (count, 3), m."""
    assert scene.free_space is not None
    found = scene.points(3 * count, rng)
    around = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * _MARGIN
    return np.asarray(found[scene.free_space.contains(found[:, None] + around).all(axis=1)][:count])


def write_drops(path: Path, points: np.ndarray, found: list[list[FoundPaths]]) -> None:
    """Write the strongest paths of each link; unused rows have a gain of minus infinity."""
    shape = (len(points), len(found[0]), _KEPT)
    gain = np.full(shape, -np.inf)
    length, heading = np.zeros(shape), np.zeros((*shape, 3))
    counts = {name: np.zeros(shape, np.int64) for name in ("num_reflections", "num_walls", "others")}
    for n, by_station in enumerate(found):
        for s, paths in enumerate(by_station):
            strongest = np.argsort(-paths.gain_db, kind="stable")[:_KEPT]
            kept = paths.chosen(strongest)
            row = (n, s, slice(len(kept)))
            gain[row], length[row], heading[row] = kept.gain_db, kept.path_length, kept.direction
            for name, values in counts.items():
                values[row] = getattr(kept, name)
    np.savez_compressed(path, position=points, gain_db=gain, path_length=length, direction=heading, **counts)


if __name__ == "__main__":
    main()
