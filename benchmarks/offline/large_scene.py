"""A million triangles: processor time and memory of each stage, from the file to the table.

Each scene is a hall of 40 x 60 x 8 m with about a million triangles: *clutter* has dented balls, pillars of 256 facets
and finely divided boxes; *boxes* has 83,000 small ones; *terrain* has a rough floor. Each runs in a separate process to
measure its own peak memory. docs/scenes.md has the figures.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from rayfix_offline.build import build_table
from rayfix_offline.check import check_site
from rayfix_offline.scene.scene import load_scene
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import prepare_scene

HALL = (40.0, 60.0, 8.0)

SITE = """
[site]
name = "{name}"
scene = "{name}.glb"
[propagation]
max_reflections = 2
[table]
windows_deg = [5, 15]
[[stations]]
id = "bs1"
position_m = [0.3, 0.3, 7.6]
[[stations]]
id = "bs2"
position_m = [39.7, 59.7, 7.6]
"""


def clutter(triangles: int, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Balls with dents, round pillars and finely cut boxes."""
    meshes: list[trimesh.Trimesh] = []
    while sum(len(mesh.faces) for mesh in meshes) < triangles:
        x, y = rng.uniform(3.0, 37.0), rng.uniform(3.0, 57.0)
        ball = trimesh.creation.icosphere(subdivisions=5, radius=rng.uniform(0.5, 1.2))
        u, v, w = ball.vertices.T
        ball.vertices *= (1.0 + 0.1 * np.sin(5.0 * u + x) * np.cos(4.0 * v) * np.sin(3.0 * w))[:, None]
        pillar = trimesh.creation.cylinder(radius=rng.uniform(0.2, 0.5), height=6.0, sections=256)
        box = trimesh.creation.box(extents=rng.uniform(0.5, 2.0, 3))
        for _ in range(5):
            box = box.subdivide()
        for mesh, height in ((ball, 2.0), (pillar, 3.5), (box, 1.2)):
            mesh.apply_translation((x, y, height))
            meshes.append(mesh)
            x, y = rng.uniform(3.0, 37.0), rng.uniform(3.0, 57.0)
    return meshes


def boxes(triangles: int, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Boxes of 2 to 10 cm, as one mesh."""
    count = triangles // 12
    low = rng.uniform((1.0, 1.0, 0.0), (38.0, 58.0, 6.0), (count, 3))
    size = rng.uniform(0.02, 0.1, (count, 3))
    unit = trimesh.creation.box()
    vertices = (unit.vertices + 0.5) * size[:, None] + low[:, None]
    faces = unit.faces + 8 * np.arange(count)[:, None, None]
    return [trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)]


def terrain(triangles: int, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Waves of 0.3 m and noise of 5 mm over the whole floor."""
    n = int(np.sqrt(triangles / 2)) + 1
    x, y = np.meshgrid(np.linspace(0, HALL[0], n), np.linspace(0, HALL[1], n), indexing="ij")
    z = 0.5 + 0.3 * np.sin(x) * np.cos(0.7 * y) + 0.005 * rng.normal(size=x.shape)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return [trimesh.Trimesh(np.stack([x, y, z], -1).reshape(-1, 3), faces, process=False)]


SCENES: dict[str, Callable[[int, np.random.Generator], list[trimesh.Trimesh]]] = {
    "clutter": clutter,
    "boxes": boxes,
    "terrain": terrain,
}


def write_site(folder: Path, name: str, triangles: int) -> Path:
    """Write a scene and its site file."""
    hall = trimesh.creation.box(bounds=[(0.0, 0.0, 0.0), HALL])
    hall.invert()
    scene = trimesh.Scene()
    for n, mesh in enumerate([hall, *SCENES[name](triangles, np.random.default_rng(0))]):
        scene.add_geometry(mesh, geom_name=f"object {n}", node_name=f"object {n}")
    (folder / f"{name}.glb").write_bytes(scene.export(file_type="glb"))
    path = folder / "site.toml"
    path.write_text(SITE.format(name=name), encoding="utf-8")
    return path


def measure(name: str, triangles: int) -> None:
    """Print a row: processor seconds of each stage, and the most memory until its end."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        # In another process, so that the making of the scene does not count.
        command = [
            sys.executable,
            "-m",
            "benchmarks.offline.large_scene",
            "--write",
            place,
            "--scenes",
            name,
            "--triangles",
            str(triangles),
        ]
        subprocess.run(command, check=True)
        site_path = folder / "site.toml"
        site = read_site(site_path)
        cells = []

        def lap(begin: float) -> None:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            cells.append(f"{time.process_time() - begin:.1f} s, {peak:.2f} GB")

        begin = time.process_time()
        scene = load_scene(folder / site.site.scene)
        lap(begin)
        begin = time.process_time()
        twin = prepare_scene(site, scene)
        lap(begin)
        sizes = f"{len(scene.faces):,} | {len(twin.planes):,} | {twin.planes.num_surfaces:,}"
        del scene, twin
        begin = time.process_time()
        check_site(site_path)
        lap(begin)
        begin = time.process_time()
        summary = build_table(site_path, folder / "t.h5")
        lap(begin)
        filled = sum(station.num_filled_cells for station in summary.stations)
        tubes = sum(station.num_components for station in summary.stations) / filled
        print(f"| {name} | {sizes} | {' | '.join(cells)} | {tubes:.0f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--triangles", type=int, default=1_000_000, help="of each scene (default 1,000,000)")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--write", type=Path, metavar="DIR", help="only write the first scene and its site file")
    options = parser.parse_args()
    if options.write is not None:
        write_site(options.write, options.scenes[0], options.triangles)
        return
    if len(options.scenes) == 1:
        measure(options.scenes[0], options.triangles)
        return
    print("| scene | triangles | planes | surfaces | load | prepare | check | build | tubes per cell |", flush=True)
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in options.scenes:
        command = [
            sys.executable,
            "-m",
            "benchmarks.offline.large_scene",
            "--scenes",
            name,
            "--triangles",
            str(options.triangles),
        ]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
