"""Cost of a large site, extrapolated from one station's rays and cells.

Give a site file, or repeat the bundled hall's clutter: ``--tiles 10 5`` is one hall of 80 x 90 m.
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh

from rayfix.example.hall import HALL_SIZE, hall_scene
from rayfix_offline.fit.cells import assemble_level, fit_cells, widen_cells
from rayfix_offline.fit.settings import CoarseFit
from rayfix_offline.job.method import Method
from rayfix_offline.job.plan import plan_build
from rayfix_offline.rays.trace import level_grid, trace_station
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.level import Level

SITE = """\
[site]
name = "tiles"
scene = "tiles.glb"
[propagation]
max_path_length_m = {length:g}
[[stations]]
id = "bs1"
position_m = [{x:g}, {y:g}, 2.4]
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("site", type=Path, nargs="?", metavar="SITE.toml")
    parser.add_argument("--tiles", type=int, nargs=2, default=(1, 1), metavar=("NX", "NY"))
    parser.add_argument("--path-length", type=float, default=60.0, help="max_path_length_m of the tiled hall")
    parser.add_argument("--stations", type=int, default=200, help="stations to plan for (default 200)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        path = options.site or write_tiles(Path(name), *options.tiles, length=options.path_length)
        measure(read_site(path), path.parent, options)


def write_tiles(folder: Path, nx: int, ny: int, *, length: float) -> Path:
    """Write a hall with the bundled hall's clutter again and again, and a station in its middle."""
    width, depth, height = HALL_SIZE
    scene = trimesh.Scene()
    room = trimesh.creation.box(bounds=[(0.0, 0.0, 0.0), (nx * width, ny * depth, height)])
    room.invert()
    scene.add_geometry(room, geom_name="room", node_name="room")
    clutter = [(n, g) for n, g in hall_scene().geometry.items() if n != "room"]
    for i in range(nx):
        for j in range(ny):
            for name, mesh in clutter:
                copy = mesh.copy()
                copy.apply_translation((i * width, j * depth, 0.0))
                scene.add_geometry(copy, geom_name=f"{name}_{i}_{j}", node_name=f"{name}_{i}_{j}")
    (folder / "tiles.glb").write_bytes(scene.export(file_type="glb"))
    path = folder / "site.toml"
    x, y = nx // 2 * width + 0.1, ny // 2 * depth + 0.1
    path.write_text(SITE.format(length=length, x=x, y=y), encoding="utf-8")
    return path


def measure(site: SiteFile, folder: Path, options: argparse.Namespace) -> None:
    """Measure the first station and print what many of them take."""
    begin = time.process_time()
    twin = prepare_twin(site, folder)
    preparing = time.process_time() - begin
    extent = " x ".join(f"{v:.0f}" for v in twin.scene.bounds[1] - twin.scene.bounds[0])
    scene_bytes = sum(a.nbytes for a in (twin.scene.vertices, twin.scene.faces, twin.scene.face_materials))
    print(
        f"scene: {extent} m, {len(twin.scene.faces):,} triangles, {scene_bytes / 1e6:.1f} MB to each worker; free "
        f"space in voxels of {twin.free_space.voxel_size:.2f} m; prepared in {preparing:.1f} s"
    )
    section, fit = site.stations[0], Method().fit(site)
    trace_station(section, site, twin)  # compiles
    begin = time.process_time()
    trace = trace_station(section, site, twin)
    tracing = time.process_time() - begin
    plan = plan_build(site, twin)[0]
    seconds, size = tracing, 0.0
    print(f"station: {len(trace.finest.rays):,} rays traced in {tracing:.1f} processor seconds")
    print("  window [deg]    cells   components   bytes/cell   processor ms/cell")
    finer: Level | None = None
    for n, window in enumerate(np.deg2rad(site.table.windows_deg)):
        cells = np.concatenate([block.cells for block in plan.blocks if block.level == n])
        for chosen in (cells[:2], cells):  # the first compiles
            begin = time.process_time()
            if finer is None:
                fitted = fit_cells(chosen, trace.finest, fit)
            else:
                fitted = widen_cells(
                    chosen, window, level_grid(window), finer, np.zeros(finer.num_cells, np.float32), CoarseFit()
                )
            spent = time.process_time() - begin
        finer = assemble_level(window, level_grid(window), [fitted])
        seconds += spent
        size += finer.num_bytes
        print(
            f"  {np.rad2deg(window):12.2f} {len(cells):8,} {len(fitted.mixture) / len(cells):12.1f} "
            f"{finer.num_bytes / len(cells):12.0f} {1e3 * spent / len(cells):19.2f}"
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(
        f"  in all {plan.num_cells:,} cells, {seconds:.0f} processor seconds, {size / 1e6:.0f} MB; peak memory of this "
        f"process {peak / 1e9:.2f} GB\n"
        f"{options.stations} stations: {plan.num_cells * options.stations / 1e6:.2f} million cells, "
        f"{seconds * options.stations / 3600:.1f} core-hours, {size * options.stations / 1e9:.1f} GB"
    )


if __name__ == "__main__":
    main()
