"""Curved surfaces: groups, components, time and held-out log-likelihood by number of facets of a pillar or a vault.

Each scene is fitted twice: with the facets of a curved surface grouped, as in a build, and separately. Only cells that
see the curved surface are used. Held-out points are from rays of another seed in a scene with so many facets that it is
practically round, like the building. docs/scenes.md has the figures.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from benchmarks.common.held_out import log_densities
from rayfix_offline.fit.em import sample_points
from rayfix_offline.fit.join_surfaces import join_groups
from rayfix_offline.fit.moments import gather_groups, gathered_rays, new_rows
from rayfix_offline.fit.settings import TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.rays.trace import LevelRays, trace_station
from rayfix_offline.site import SiteFile, parse_site
from rayfix_offline.twin.twin import Twin, prepare_twin
from rayfix_tables.compact.tubes import compacted
from rayfix_tables.geometry.angles import wrap

STATION = (0.3, 0.4, 2.6)
PILLAR = (4.0, 5.0)
HELD_OUT_POINTS = 2000


def pillar_room(facets: int) -> trimesh.Scene:
    """Room of 8 x 10 x 3 m with a round pillar of 0.8 m; with 4 facets, a square one."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(bounds=[(0, 0, 0), (8, 10, 3)]), geom_name="room", node_name="room")
    pillar = trimesh.creation.cylinder(radius=0.4, height=2.98, sections=facets)
    pillar.apply_translation((*PILLAR, 1.49))
    scene.add_geometry(pillar, geom_name="pillar", node_name="pillar")
    return scene


def vault(facets: int) -> trimesh.Scene:
    """Room of 8 x 10 m under a barrel vault of ``facets`` strips, each cut into ``facets`` pieces along."""
    turn = np.linspace(0, np.pi, facets + 1)
    along = np.linspace(0, 10, facets + 1)
    x, z = 4.0 - 4.0 * np.cos(turn), 3.0 + 1.5 * np.sin(turn)
    vertices = np.array([(a, y, b) for a, b in zip(x, z, strict=True) for y in along])
    faces = []
    step = facets + 1
    for i in range(facets):
        for j in range(facets):
            k = i * step + j
            faces += [(k, k + step, k + step + 1), (k, k + step + 1, k + 1)]
    roof = trimesh.Trimesh(vertices, faces, process=False)
    floor = trimesh.Trimesh([(0, 0, 0), (8, 0, 0), (8, 10, 0), (0, 10, 0)], [(0, 1, 2), (0, 2, 3)])
    sides = [trimesh.Trimesh([(a, 0, 0), (a, 10, 0), (a, 10, 3), (a, 0, 3)], [(0, 1, 2), (0, 2, 3)]) for a in (0, 8)]
    ends = []
    for y, edge in ((0.0, 0), (10.0, facets)):
        rim = vertices[edge::step]
        fan = np.concatenate([[(4.0, y, 0.0), (0.0, y, 0.0)], rim, [(8.0, y, 0.0)]])
        ends.append(trimesh.Trimesh(fan, [(0, n, n + 1) for n in range(1, len(fan) - 1)]))
    scene = trimesh.Scene()
    for name, mesh in [("roof", roof), ("floor", floor), ("sides", trimesh.util.concatenate(sides + ends))]:
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    return scene


@dataclass(frozen=True, kw_only=True)
class Study:
    """A scene, the numbers of its facets, and the one that counts as round."""

    make: Callable[[int], trimesh.Scene]
    facets: tuple[int, ...]
    round: int


STUDIES = {
    "pillar": Study(make=pillar_room, facets=(16, 64, 256, 1024), round=2048),
    "vault": Study(make=vault, facets=(16, 64, 128), round=256),
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the fit of some cells came to: means over them, but for the largest number of groups and the least mass."""

    groups: float
    most_groups: int
    kept_mass: float
    components: float
    milliseconds: float
    joint: float
    place: float


def load(scene: trimesh.Scene, windows: list[float]) -> tuple[Twin, SiteFile]:
    """Prepare the twin of a scene."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "scene.glb").write_bytes(scene.export(file_type="glb"))
        site = parse_site(
            {
                "site": {"name": "curved", "scene": "scene.glb"},
                "propagation": {"max_reflections": 2},
                "table": {"windows_deg": windows},
                "stations": [{"id": "bs1", "position_m": list(STATION)}],
            }
        )
        return prepare_twin(site, Path(folder)), site


def looking_at(level: LevelRays, name: str, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Cells whose centre looks at the pillar, or at the roof."""
    centres = level.grid.centres
    if name == "pillar":
        azimuth = np.arctan2(PILLAR[1] - STATION[1], PILLAR[0] - STATION[0])
        near = np.abs(wrap(centres[:, 0] - azimuth)) < 0.07 + 0.5 * level.window
        near &= (centres[:, 1] > 1.4) & (centres[:, 1] < 2.0)
    else:
        near = (centres[:, 1] < 1.45) & (centres[:, 0] > 0.0) & (centres[:, 0] < 1.57) & (centres[:, 1] > 0.4)
    cells = np.flatnonzero(near)
    return np.sort(rng.choice(cells, size=min(count, len(cells)), replace=False))


def measure(level: LevelRays, cells: NDArray[np.int64], points: list[NDArray[np.float64]]) -> Outcome:
    """Fit cells and judge them on held-out points."""
    fit = TubeFit()
    centres = level.grid.centres[cells]
    sequences = level.sequences
    gathered = gathered_rays(level.rays, level.pieces, sequences)
    groups, kept = [], []
    for centre in centres:
        seq, slices, walls, mass, mean, cov = gather_groups(
            *centre, level.window, fit.cutoff, gathered, level.pieces.num_slices, new_rows(len(sequences.images))
        )
        surface = level.surface_sequences[seq]
        mass = join_groups(surface, slices, mass, mean, cov, sequences.mirrors[seq], walls)[1]
        groups.append(len(mass))
        kept.append(np.sort(mass)[::-1][: fit.max_groups].sum() / mass.sum())
    begin = time.process_time()
    counts, _, mixture, _ = fit_tubes(centres, level, fit)
    seconds = time.process_time() - begin
    ends, stored = np.cumsum(counts), compacted(mixture, level.window)
    scores = np.array(
        [
            [density.mean() for density in log_densities(stored[int(end - count) : int(end)], mine)]
            for end, count, mine in zip(ends, counts, points, strict=True)
        ]
    )
    return Outcome(
        groups=float(np.mean(groups)),
        most_groups=max(groups),
        kept_mass=float(np.min(kept)),
        components=float(counts.mean()),
        milliseconds=1e3 * seconds / len(cells),
        joint=float(scores[:, 0].mean()),
        place=float(scores[:, 1].mean()),
    )


def study(name: str, windows: list[float], count: int) -> Iterator[str]:
    """Give a line for each number of facets, window and way to gather."""
    scene = STUDIES[name]
    for facets in scene.facets:
        for window in windows:
            twin, site = load(scene.make(facets), [window])
            level = trace_station(site.stations[0], site, twin).finest
            other = site.model_copy(update={"table": site.table.model_copy(update={"seed": 2})})
            drawn = trace_station(site.stations[0], other, load(scene.make(scene.round), [window])[0]).finest
            rng = np.random.default_rng(0)
            cells = looking_at(level, name, count, rng)
            points = [sample_points(level.grid.centres[c], drawn, HELD_OUT_POINTS, rng)[0] for c in cells]
            apart = replace(level, surface_sequences=np.arange(len(level.sequences.images)))
            fit_tubes(level.grid.centres[cells[:1]], level, TubeFit())  # compiled before it is timed
            for how, variant in (("each", apart), ("together", level)):
                o = measure(variant, cells, points)
                ways = len(np.unique(variant.surface_sequences))
                yield (
                    f"| {name} | {facets} | {np.rad2deg(level.window):g} | {how} | {ways} | {o.groups:.0f} | "
                    f"{o.most_groups} | {o.kept_mass:.1%} | {o.components:.0f} | {o.milliseconds:.1f} | "
                    f"{o.joint:.2f} | {o.place:.2f} |"
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=40, help="cells of each window (default 40)")
    parser.add_argument("--windows", type=float, nargs="+", default=[1.25, 5.0], help="deg (default 1.25 5)")
    parser.add_argument("--scenes", nargs="+", default=list(STUDIES), choices=list(STUDIES))
    options = parser.parse_args()
    print("| scene | facets | window, deg | gathered | sequences | groups | most | mass | tubes | ms | joint | place |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for name in options.scenes:
        for line in study(name, options.windows, options.cells):
            print(line, flush=True)


if __name__ == "__main__":
    main()
