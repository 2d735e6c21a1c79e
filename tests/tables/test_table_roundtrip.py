"""A table that is written and opened again is the same table, bit for bit."""

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_tables.disk.schema import WHOLE_VERSION, array_digest, read_text, write_text
from rayfix_tables.errors import CorruptTableError
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.mixture import FIELD_DTYPES, FIELD_SHAPES
from rayfix_tables.part import Update
from rayfix_tables.paths import PATH_FIELDS, PathMap
from rayfix_tables.site import NO_BIAS, Selection, Station
from rayfix_tables.table import Table

DEGREES = 1e-14  # relative; angles are stored in degrees


def assert_same_bits(actual: Any, expected: Any) -> None:
    """Check shape, type and every bit, so that -0.0 is not 0.0."""
    assert actual.shape == expected.shape
    assert actual.dtype == expected.dtype
    assert actual.tobytes() == expected.tobytes()


def assert_same_table(table: Table, content: Any) -> None:
    """Check that a table holds the content that it was written from."""
    site = content.site
    assert (table.site.name, table.site.max_path_length) == (site.name, site.max_path_length)
    assert table.site.document == site.document
    assert table.site.north == pytest.approx(site.north, rel=DEGREES)
    assert list(table.parts) == [station.id for station in site.stations]
    for station, written, part in zip(site.stations, content.parts, table.parts.values(), strict=True):
        assert part.station.id == station.id
        assert part.station.position == station.position
        assert part.station.orientation == pytest.approx(station.orientation, rel=DEGREES)
        assert part.station.field_of_view == pytest.approx(station.field_of_view, rel=DEGREES)
        assert part.station.bias.angles == station.bias.angles
        assert part.station.deviations == station.deviations
        assert part.station.selection == station.selection
        found, bias = (vars(replace(each.bias, angles=None)) for each in (part.station, station))
        del found["angles"], bias["angles"]
        assert found == pytest.approx(bias, rel=DEGREES)
        assert (part.lost_ray_share, part.coverage) == (written.lost_ray_share, written.coverage)
        assert (part.wall_coverage, part.cut_power_share) == (written.wall_coverage, written.cut_power_share)
        assert table.levels(station.id) is part.levels
        assert_same_paths(part.paths, paths_in(table.format_version, written.paths))
        for level, expected in zip(part.levels, written.levels, strict=True):
            assert level.window == pytest.approx(expected.window, rel=DEGREES)
            assert (level.num_cells, level.num_components) == (expected.grid.num_cells, len(expected.mixture))
            assert_same_bits(level.grid.ring_cells, expected.grid.ring_cells)
            assert_same_bits(level.cell_offsets, expected.cell_offsets)
            assert_same_bits(level.cell_log_mass, expected.cell_log_mass)
            assert_same_bits(level.log_balance, expected.log_balance)
            # Balanced or not, of one type: kernels compiled for one table serve the other.
            assert not level.log_balance.flags.writeable or not len(level.mixture)
            for name in FIELD_SHAPES:
                assert_same_bits(getattr(level.mixture, name), getattr(expected.mixture, name))
    scene = content.scene
    assert (table.scene.materials, table.scene.sha256) == (scene.materials, scene.sha256)
    for name in ("vertices", "faces", "face_materials"):
        assert_same_bits(getattr(table.scene, name), getattr(scene, name))
    assert (table.scene.face_thickness is None) == (scene.face_thickness is None)
    if scene.face_thickness is not None:
        np.testing.assert_array_equal(table.scene.face_thickness, scene.face_thickness)
    assert_same_bits(table.scene.free_space.free, scene.free_space.free)
    assert_same_bits(table.scene.free_space.origin, scene.free_space.origin)
    assert table.scene.free_space.voxel_size == scene.free_space.voxel_size


def paths_in(version: int, paths: PathMap | None) -> PathMap | None:
    """Return what a table of a version has of a station's map of paths."""
    if paths is None or version < 3:
        return None
    if version == 3:
        return replace(paths, log_gain=np.zeros(0, np.float16), lit=np.zeros(0, np.float16))
    return paths


def assert_same_paths(actual: PathMap | None, expected: PathMap | None) -> None:
    """Check a station's map of paths, which tables of former versions do not have."""
    if actual is None or expected is None:
        assert actual is expected
        return
    assert (actual.voxel_size, actual.shape) == (expected.voxel_size, expected.shape)
    assert_same_bits(actual.origin, expected.origin)
    for name in PATH_FIELDS:
        assert_same_bits(getattr(actual, name), getattr(expected, name))


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_stations=st.integers(1, 3),
    num_levels=st.integers(1, 3),
    num_faces=st.integers(1, 50),
    max_components=st.integers(0, 4),
    walls=st.booleans(),
)
def test_round_trip(
    make_content: Callable[..., Any],
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    num_stations: int,
    num_levels: int,
    num_faces: int,
    max_components: int,
    walls: bool,
) -> None:
    path = tmp_path_factory.mktemp("tables") / "table.h5"
    content = make_content(
        seed,
        num_stations=num_stations,
        num_levels=num_levels,
        num_faces=num_faces,
        max_components=max_components,
        walls=walls,
    )
    table_id = content.write(path)
    table = Table.open(path)
    assert_same_table(table, content)
    assert table.table_id == table_id
    assert (table.path, table.format_version, table.software_version) == (path, WHOLE_VERSION, "1.2.3")
    table.verify()
    assert [entry.name for entry in path.parent.iterdir()] == ["table.h5"]


def test_parts_of_other_stations_are_refused(make_content: Callable[..., Any], tmp_path: Path) -> None:
    content = make_content(0)
    with pytest.raises(ValueError, match="the parts of a table are those of its site's stations"):
        replace(content, parts=content.parts[::-1]).write(tmp_path / "t.h5")
    assert not list(tmp_path.iterdir())


def with_selection(content: Any, selection: Selection) -> Any:
    """Content whose stations select by a rule."""
    stations = tuple(replace(station, selection=selection) for station in content.site.stations)
    parts = tuple(replace(part, station=station) for part, station in zip(content.parts, stations, strict=True))
    return replace(content, site=replace(content.site, stations=stations), parts=parts)


@pytest.mark.parametrize(
    "selection",
    [Selection(rule="first"), Selection(rule="strongest", exponent=3.5), Selection(rule="any", within_db=7.0)],
)
def test_selection_rules_come_back(make_content: Callable[..., Any], tmp_path: Path, selection: Selection) -> None:
    content = with_selection(make_content(0), selection)
    content.write(tmp_path / "t.h5")
    assert_same_table(Table.open(tmp_path / "t.h5"), content)


@pytest.mark.parametrize("text", ["{}", '"first"', '{"rule": "loudest", "exponent": 2, "within_db": null}', "{"])
def test_damaged_selection_rules_are_refused(make_content: Callable[..., Any], tmp_path: Path, text: str) -> None:
    with_selection(make_content(0), Selection(rule="first")).write(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "r+") as file:
        write_text(file["stations/bs0"], "selection", text)
    with pytest.raises(CorruptTableError):
        Table.open(tmp_path / "t.h5")


def test_extreme_numbers_come_back(make_content: Callable[..., Any], tmp_path: Path) -> None:
    content = make_content(0, num_stations=1, num_levels=1)
    level = content.parts[0].levels[0]
    extremes = np.array([-0.0, 0.0, -3.4e38, 1.2e-38, 1e-45, 3.4e38], np.float32)
    level.mixture.u_cov[0] = extremes
    content.write(tmp_path / "t.h5")
    table = Table.open(tmp_path / "t.h5")
    assert_same_table(table, content)
    table.verify()


def test_double_precision_is_rounded_to_the_stored_types(make_content: Callable[..., Any], tmp_path: Path) -> None:
    content = make_content(0, num_stations=1, num_levels=1)
    level = content.parts[0].levels[0]
    doubles = {f.name: getattr(level.mixture, f.name) * np.float64(np.pi) for f in fields(level.mixture)}
    exact = replace(level, mixture=replace(level.mixture, **doubles))
    replace(content, parts=(replace(content.parts[0], levels=(exact,)),)).write(tmp_path / "t.h5")
    mixture = Table.open(tmp_path / "t.h5").levels("bs0")[0].mixture
    for name, dtype in FIELD_DTYPES.items():
        assert_same_bits(getattr(mixture, name), doubles[name].astype(dtype))


def test_a_cell_is_its_slice_of_the_components(make_content: Callable[..., Any], tmp_path: Path) -> None:
    content = make_content(3, num_stations=1, num_levels=1)
    content.write(tmp_path / "t.h5")
    level = Table.open(tmp_path / "t.h5").levels("bs0")[0]
    written = content.parts[0].levels[0]
    counts = [len(level.cell(i)) for i in range(level.num_cells)]
    assert counts == np.diff(written.cell_offsets).tolist()
    assert 0 in counts
    joined = np.concatenate([level.cell(i).u_mean for i in range(level.num_cells)])
    assert_same_bits(joined, written.mixture.u_mean)


def test_ranges_of_cells_are_all_cells_in_order(make_content: Callable[..., Any]) -> None:
    level = make_content(3).parts[0].levels[0]
    counts = np.diff(level.cell_offsets)
    for most in (1, 4, 10**6):
        ranges = list(level.ranges(most))
        assert [first for first, _ in ranges] == [0, *(last for _, last in ranges[:-1])]
        assert ranges[-1][1] == level.num_cells
        assert all(counts[first:last].sum() <= most or last == first + 1 for first, last in ranges)


def test_a_table_written_before_there_were_biases_has_none(small_table_path: Path, tmp_path: Path) -> None:
    path = tmp_path / "former.h5"
    path.write_bytes(small_table_path.read_bytes())
    with h5py.File(path, "r+") as file:
        for group in file["stations"].values():
            for name in [name for name in group.attrs if "bias" in name]:
                del group.attrs[name]
    assert all(station.bias == NO_BIAS for station in Table.open(path).site.stations)


def test_a_table_of_format_1_is_still_read(make_content: Callable[..., Any]) -> None:
    """Its texts are attributes of variable length."""
    path = Path(__file__).parent / "stored" / "format-1.h5"
    table = Table.open(path)
    assert_same_table(table, make_content(1, num_stations=1, num_levels=1))
    assert table.format_version == 1
    assert table.table_id == "4506b08f92814eda2c4c9d246dbb340c18f557041afaf38eb6bdc473c134eea3"
    table.verify()


def test_a_table_of_format_2_is_still_read(make_content: Callable[..., Any]) -> None:
    """It has no map of paths."""
    table = Table.open(Path(__file__).parent / "stored" / "format-2.h5")
    assert_same_table(table, make_content(1, num_stations=1, num_levels=1))
    assert table.format_version == 2
    assert table.table_id == "0f8e18f4ac3affc58843f00b295cd47e17c823f437c4985cf99b51e077d87313"
    table.verify()


def test_a_table_of_format_3_is_still_read(make_content: Callable[..., Any]) -> None:
    """Its map of paths has no gains."""
    table = Table.open(Path(__file__).parent / "stored" / "format-3.h5")
    assert_same_table(table, make_content(1, num_stations=1, num_levels=1))
    assert table.format_version == 3
    assert table.table_id == "ccb62c9bcc064a2d42a9ca114ae1fa1c2594ba389079d452f4cb1ea8d0ecf14d"
    table.verify()


def test_a_table_of_format_4_is_still_read(make_content: Callable[..., Any]) -> None:
    """Its components are not compact."""
    table = Table.open(Path(__file__).parent / "stored" / "format-4.h5")
    assert_same_table(table, make_content(1, num_stations=1, num_levels=1))
    assert table.format_version == 4
    assert table.table_id == "5493cdcca5929250836251990f1700f2010c9503c0e527b07f7b9aeff66fcefd"
    table.verify()


def far_content(make_content: Callable[..., Any]) -> Any:
    """Content whose scene and stations lie at whole metres far away; components count from there."""
    content = make_content(7)
    origin = np.array([448254.0, 5412335.0, 0.0])
    stations = tuple(
        replace(s, position=tuple((np.round(s.position, 3) + origin).tolist())) for s in content.site.stations
    )
    parts = tuple(replace(p, station=s) for p, s in zip(content.parts, stations, strict=True))
    scene = replace(content.scene, vertices=np.round(content.scene.vertices, 3)).moved(origin)
    return replace(content, site=replace(content.site, stations=stations), scene=scene, parts=parts)


def test_a_scene_on_map_coordinates_comes_back_to_the_last_bit(
    make_content: Callable[..., Any], tmp_path: Path
) -> None:
    content = far_content(make_content)
    content.write(tmp_path / "t.h5")
    table = Table.open(tmp_path / "t.h5")
    assert_same_table(table, content)
    assert_same_bits(table.scene.origin, content.scene.origin)
    table.verify()
    with h5py.File(tmp_path / "t.h5") as file:
        assert np.abs(file["scene/vertices_m"][()]).max() < 10.0
        assert np.abs(file["stations/bs0"].attrs["position_m"]).max() < 10.0
        assert np.abs(file["scene/free_space"].attrs["origin_m"]).max() < 10.0


def test_near_the_origin_nothing_is_said_of_it(small_table_path: Path) -> None:
    with h5py.File(small_table_path) as file:
        assert "origin_m" not in file["scene"].attrs
    table = Table.open(small_table_path)
    assert table.scene.in_table_frame is table.scene
    assert not table.scene.origin.any()


def test_arrays_are_mapped_and_cannot_be_written(small_table_path: Path) -> None:
    """A view of the file itself, 64-byte aligned; nothing of it is read in advance."""
    table = Table.open(small_table_path)
    raw = small_table_path.read_bytes()
    with h5py.File(small_table_path) as file:
        for n, level in enumerate(table.levels("bs0")):
            for name in FIELD_SHAPES.keys() - {"num_walls"}:  # which only tables with walls have
                array = getattr(level.mixture, name)
                offset = file[f"stations/bs0/levels/{n}/{name}"].id.get_offset()
                assert offset % 64 == 0
                assert raw[offset : offset + array.nbytes] == array.tobytes()
                assert not array.flags.owndata
                with pytest.raises(ValueError, match="read-only"):
                    array[0] = 0


def test_the_site_is_plain_json(small_table_path: Path, make_content: Callable[..., Any]) -> None:
    """Other programs can read it."""
    with h5py.File(small_table_path) as file:
        assert read_text(file, "format") == "rayfix-table"
        assert file.attrs["format_version"] == WHOLE_VERSION
        document = json.loads(file["site"][()].tobytes())
    site = make_content(1).site
    assert document["station_ids"] == ["bs0", "bs1"]
    assert document["north_deg"] == pytest.approx(np.rad2deg(site.north), rel=DEGREES)
    assert document["document"] == site.document


# table_id


def test_the_id_does_not_tell_who_wrote_it_where(make_content: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    first = make_content(5).write(tmp_path / "a.h5", software_version="1.0")
    second = make_content(5).write(tmp_path / "folder" / "b.h5", software_version="2.0")
    assert first == second
    assert len(first) == 64
    assert Table.open(tmp_path / "a.h5").software_version != Table.open(tmp_path / "folder/b.h5").software_version


def test_a_digest_is_of_type_shape_and_bytes() -> None:
    array = np.arange(6, dtype=np.int64)
    others = [array.reshape(2, 3), array.reshape(3, 2), array.view(np.uint64), array[::-1], array[:5], array[:0]]
    assert len({array_digest(other) for other in [array, *others]}) == 7
    whole = np.arange(12).reshape(3, 4)
    assert array_digest(whole[:, ::2]) == array_digest(whole[:, ::2].copy())


def nudged(array: np.ndarray) -> np.ndarray:
    """Change the least bit of one number in the middle."""
    changed = array.copy()
    flat = changed.reshape(-1)
    middle = len(flat) // 2
    if np.issubdtype(array.dtype, np.floating):
        flat[middle] = np.nextafter(flat[middle], np.inf, dtype=array.dtype)
    else:
        flat[middle] ^= 1
    return changed


def variations(content: Any) -> dict[str, Any]:
    """Contents that differ in one thing each."""
    near = 1.0 + 1e-12
    site, scene, (first, *others) = content.site, content.scene, content.parts
    level, *coarser = first.levels
    station, *stations = site.stations

    def with_station(**changes: Any) -> Any:
        changed = Station(**{**{f.name: getattr(station, f.name) for f in fields(station)}, **changes})
        part = replace(first, station=changed)
        return replace(content, site=replace(site, stations=(changed, *stations)), parts=(part, *others))

    def with_level(**changes: Any) -> Any:
        levels = (replace(level, **changes), *coarser)
        return replace(content, parts=(replace(first, levels=levels), *others))

    def with_part(**changes: Any) -> Any:
        return replace(content, parts=(replace(first, **changes), *others))

    def with_scene(**changes: Any) -> Any:
        return replace(content, scene=replace(scene, **changes))

    space: FreeSpace = scene.free_space
    x, y, z = station.position
    varied = {
        "name": replace(content, site=replace(site, name="other")),
        "north": replace(content, site=replace(site, north=site.north * near)),
        "max_path_length": replace(content, site=replace(site, max_path_length=site.max_path_length * near)),
        "document": replace(content, site=replace(site, document={**site.document, "more": 1})),
        "station id": with_station(id="other"),
        "position": with_station(position=(x, y, z * near)),
        "orientation": with_station(orientation=(0.1, 0.2, 0.3)),
        "mounting": with_station(mounting="silabs"),
        "field_of_view": with_station(field_of_view=station.field_of_view * near),
        "bias": with_station(bias=replace(station.bias, range=station.bias.range * near)),
        "lost_ray_share": with_part(lost_ray_share=first.lost_ray_share * near),
        "coverage": with_part(coverage=(*first.coverage[:-1], first.coverage[-1] * near)),
        "no coarse level": with_part(levels=(level,)),
        "window": with_level(window=level.window * near),
        "ring_cells": with_level(grid=AngularGrid(ring_cells=level.grid.ring_cells[::-1] + np.arange(20)[-1])),
        "cell_offsets": with_level(cell_offsets=nudged(level.cell_offsets)),
        "cell_log_mass": with_level(cell_log_mass=level.cell_log_mass + 1e-12),
        "log_balance": with_level(log_balance=nudged(level.log_balance)),
        "no balance": with_level(log_balance=level.log_balance[:0]),
        "vertices": with_scene(vertices=nudged(scene.vertices)),
        "faces": with_scene(faces=nudged(scene.faces)),
        "face_materials": with_scene(face_materials=nudged(scene.face_materials)),
        "materials": with_scene(materials=("itu_concrete", "itu_glass")),
        "sha256": with_scene(sha256="0" * 64),
        "face_thickness": with_scene(face_thickness=np.full(len(scene.faces), 0.1)),
        "wall_coverage": with_part(wall_coverage=(0.5,)),
        "free": with_scene(free_space=replace(space, free=~space.free)),
        "origin": with_scene(free_space=replace(space, origin=nudged(space.origin))),
        "voxel_size": with_scene(free_space=replace(space, voxel_size=0.2)),
    }
    for name in FIELD_SHAPES:
        mixture = replace(level.mixture, **{name: nudged(getattr(level.mixture, name))})
        varied[name] = with_level(mixture=mixture)
    return varied


def test_the_id_changes_with_every_part_of_the_content(make_content: Callable[..., Any], tmp_path: Path) -> None:
    content = make_content(6)
    ids = {"": content.write(tmp_path / "t.h5")}
    for name, varied in variations(content).items():
        ids[name] = varied.write(tmp_path / "t.h5")
    assert len(set(ids.values())) == len(ids)
    assert len(ids) == 30 + len(FIELD_SHAPES)


def with_update(content: Any, seed: int = 0) -> Any:
    """Content whose first station was updated."""
    rng = np.random.default_rng(seed)
    first = content.parts[0]
    change = tuple((0.01 * rng.random(level.num_cells)).astype(np.float32) for level in first.levels)
    update = Update(exact_part_id="e" * 64, former_part_id="f" * 64, tolerance=0.01, cell_change=change)
    return replace(content, parts=(replace(first, update=update), *content.parts[1:]))


def test_an_update_is_part_of_the_table(make_content: Callable[..., Any], tmp_path: Path) -> None:
    content = make_content(5)
    updated = with_update(content)
    table_id = updated.write(tmp_path / "updated.h5")
    table = Table.open(tmp_path / "updated.h5")
    table.verify()
    assert_same_table(table, updated)
    first, second = table.parts.values()
    assert second.update is None
    expected = updated.parts[0].update
    for ours, theirs in zip(first.update.cell_change, expected.cell_change, strict=True):
        assert_same_bits(ours, theirs)
    assert replace(first.update, cell_change=()) == replace(expected, cell_change=())
    assert first.update.largest_change == max(float(change.max()) for change in expected.cell_change)
    assert table_id == table.table_id
    assert len({table_id, content.write(tmp_path / "whole.h5"), with_update(content, 1).write(tmp_path / "o.h5")}) == 3


@pytest.mark.parametrize("damage", ["missing", "short", "type"])
def test_a_damaged_update(make_content: Callable[..., Any], tmp_path: Path, damage: str) -> None:
    path = tmp_path / "updated.h5"
    with_update(make_content(5)).write(path)
    with h5py.File(path, "r+") as file:
        group = file["stations/bs0/levels/1"]
        change = group["cell_change"][()]
        del group["cell_change"]
        if damage != "missing":
            group["cell_change"] = change[:-1] if damage == "short" else change.astype(np.float64)
    with pytest.raises(CorruptTableError, match="cell_change"):
        Table.open(path)


def test_a_table_is_shown_in_a_line(make_content: Callable[..., Any], tmp_path: Path) -> None:
    make_content(1).write(tmp_path / "t.h5")
    table = Table.open(tmp_path / "t.h5")
    assert "\n" not in repr(table)
    assert all(part in repr(table) for part in ("t.h5", table.site.name, table.table_id[:12]))
