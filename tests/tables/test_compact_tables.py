"""Tables of compact components: written and opened again bit for bit, and refused where they are damaged."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_tables.checked import open_checked
from rayfix_tables.compact.tubes import COMPACT_FIELDS
from rayfix_tables.disk.schema import FORMAT_VERSION, WHOLE_VERSION, array_digest, write_text
from rayfix_tables.errors import CorruptTableError
from rayfix_tables.paths import PATH_FIELDS
from rayfix_tables.table import Table
from tests.support.tables.random_tables import Content, compact_content, random_content

LEVEL, PATHS = "stations/bs0/levels/0", "stations/bs0/paths"


@pytest.fixture
def compact_path(tmp_path: Path) -> Path:
    """Path of a table of compact components; the test may damage it."""
    compact_content(1).write(tmp_path / "compact.h5")
    return tmp_path / "compact.h5"


def assert_same_bits(actual: Any, expected: Any) -> None:
    assert (actual.shape, actual.dtype) == (expected.shape, expected.dtype)
    assert actual.tobytes() == expected.tobytes()


def assert_same_parts(table: Table, content: Content) -> None:
    for written, part in zip(content.parts, table.parts.values(), strict=True):
        for level, expected in zip(part.levels, written.levels, strict=True):
            assert level.window == level.mixture.window == expected.window  # to the last bit
            assert_same_bits(level.log_balance, expected.log_balance)
            assert not level.log_balance.flags.writeable or not len(level.mixture)
            for name in COMPACT_FIELDS:
                assert_same_bits(getattr(level.mixture, name), getattr(expected.mixture, name))
        assert part.paths.weight_unit == written.paths.weight_unit
        for name in PATH_FIELDS:
            assert_same_bits(getattr(part.paths, name), getattr(written.paths, name))


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_levels=st.integers(1, 3),
    max_components=st.integers(0, 4),
    walls=st.booleans(),
)
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, seed: int, num_levels: int, max_components: int, walls: bool
) -> None:
    path = tmp_path_factory.mktemp("tables") / "table.h5"
    content = compact_content(seed, walls=walls, num_levels=num_levels, max_components=max_components)
    table_id = content.write(path)
    table = Table.open(path)
    assert_same_parts(table, content)
    assert (table.table_id, table.format_version) == (table_id, FORMAT_VERSION)
    table.verify()
    assert_same_parts(open_checked(path, whole=True), content)


def test_a_compact_table_is_smaller(tmp_path: Path) -> None:
    compact, whole = (make(3, max_components=200, num_levels=1) for make in (compact_content, random_content))
    for content, path in ((compact, tmp_path / "compact.h5"), (whole, tmp_path / "whole.h5")):
        content.write(path)
    levels = [content.parts[0].levels[0] for content in (compact, whole)]
    count = len(levels[0].mixture)
    assert count == len(levels[1].mixture) > 1000
    sizes = [level.mixture.num_bytes - count + level.log_balance.nbytes for level in levels]  # walls are not written
    assert sizes == [67 * count, 117 * count]
    assert (tmp_path / "compact.h5").stat().st_size < 0.62 * (tmp_path / "whole.h5").stat().st_size


def test_either_all_is_compact_or_none(tmp_path: Path) -> None:
    whole, compact = random_content(1), compact_content(1)
    assert whole.write(tmp_path / "t.h5") != compact.write(tmp_path / "t.h5")
    mixed_parts = replace(whole, parts=(whole.parts[0], compact.parts[1]))
    first = compact.parts[0]
    mixed_levels = (replace(first, levels=(first.levels[0], whole.parts[0].levels[1])), compact.parts[1])
    mixed_map = (replace(first, paths=whole.parts[0].paths), compact.parts[1])
    for parts in (mixed_parts.parts, mixed_levels, mixed_map):
        with pytest.raises(ValueError, match="are compact, others are not"):
            replace(compact, parts=parts).write(tmp_path / "t.h5")
    whole.write(tmp_path / "t.h5")
    assert Table.open(tmp_path / "t.h5").format_version == WHOLE_VERSION


def test_components_are_read_in_either_form(compact_path: Path) -> None:
    level = Table.open(compact_path).parts["bs0"].levels[0]
    cell = int(np.argmax(np.diff(level.cell_offsets)))
    rows = np.arange(level.cell_offsets[cell], level.cell_offsets[cell + 1])
    assert_same_bits(level.cell(cell).x_cov, level.expanded.mixture.x_cov[rows])
    assert level.is_compact
    assert not level.expanded.is_compact
    assert level.expanded.expanded is not level
    assert level.num_bytes < 0.6 * level.expanded.num_bytes


def test_arrays_are_mapped_and_cannot_be_written(compact_path: Path) -> None:
    level = Table.open(compact_path).parts["bs0"].levels[0]
    with h5py.File(compact_path) as file:
        for name in COMPACT_FIELDS.keys() - {"num_walls"}:
            assert file[f"{LEVEL}/{name}"].id.get_offset() % 64 == 0
    for array in level.mixture.arrays:
        assert not array.flags.owndata
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def changed(values: np.ndarray, index: Any, number: float) -> np.ndarray:
    values = values.copy()
    values[index] = number
    return values


@pytest.mark.parametrize(
    ("name", "index", "number", "message"),
    [
        (f"{LEVEL}/angles16", (2, 1), np.inf, "not finite"),
        (f"{LEVEL}/u_root16", (2, 3), np.nan, "not finite"),
        (f"{LEVEL}/u_root16", (2, 2), 0.0, "not positive"),
        (f"{LEVEL}/x_root16", (2, 1), -np.inf, "not finite"),
        (f"{LEVEL}/x_root16", (2, 5), -0.01, "not positive"),
        (f"{LEVEL}/slopes16", (2, 1, 1), np.nan, "not finite"),
        (f"{LEVEL}/log_balance16", 2, np.nan, "not finite"),
        (f"{LEVEL}/length", 2, 0.0, "not positive"),
        (f"{LEVEL}/length", 2, np.nan, "not finite"),
        (f"{LEVEL}/x_mean", (2, 0), np.inf, "not finite"),
        (f"{PATHS}/weight16", 2, np.inf, "not finite"),
        (f"{PATHS}/sequence16", 2, 5, "not from 0 to 4"),
    ],
)
def test_numbers_out_of_range_are_refused(
    compact_path: Path, name: str, index: Any, number: float, message: str
) -> None:
    with h5py.File(compact_path, "r+") as file:
        dataset = file[name]
        dataset[...] = changed(dataset[()], index, number)
        del dataset.attrs["sha256"]
        write_text(dataset, "sha256", array_digest(dataset[()]))
    with pytest.raises(CorruptTableError, match=f"{name} has numbers that are {message}"):
        Table.open(compact_path)


def resized(make: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.File, str], None]:
    def change(file: h5py.File, name: str) -> None:
        values = file[name][()]
        del file[name]
        file[name] = make(values)

    return change


@pytest.mark.parametrize(
    ("name", "change"),
    [
        *((f"{LEVEL}/{name}", resized(lambda v: v[:-1])) for name in COMPACT_FIELDS if name != "num_walls"),
        *((f"{LEVEL}/{name}", lambda file, name: file.pop(name)) for name in COMPACT_FIELDS if name != "num_walls"),
        (f"{LEVEL}/log_balance16", resized(lambda v: v[:-1])),
        (f"{LEVEL}/u_root16", resized(lambda v: v.astype(np.float32))),
        (f"{LEVEL}/slopes16", resized(lambda v: v.reshape(len(v), 9))),
        (f"{LEVEL}/log_weight16", resized(lambda v: v.astype(np.int16))),
        (f"{LEVEL}/angles16", resized(lambda v: np.column_stack([v, v]))),
        (f"{PATHS}/weight16", resized(lambda v: v[:-1])),
        (f"{PATHS}/weight16", lambda file, name: file.pop(name)),
        (f"{PATHS}/sequence16", lambda file, name: file.pop(name)),
        (f"{LEVEL}@window_rad", None),
        (f"{PATHS}@weight_unit", None),
    ],
)
def test_what_is_missing_or_of_another_shape_is_refused(compact_path: Path, name: str, change: Any) -> None:
    with h5py.File(compact_path, "r+") as file:
        if change is None:
            group, attribute = name.split("@")
            del file[group].attrs[attribute]
        else:
            change(file, name)
    with pytest.raises(CorruptTableError):
        Table.open(compact_path)


@pytest.mark.parametrize("unit", [0.0, -1.0, np.nan, 1e300])
def test_units_out_of_range_are_refused(compact_path: Path, unit: float) -> None:
    for group, name in ((LEVEL, "window_rad"), (PATHS, "weight_unit")):
        with h5py.File(compact_path, "r+") as file:
            before = file[group].attrs[name]
            file[group].attrs[name] = unit
        with pytest.raises(CorruptTableError, match=name):
            Table.open(compact_path)
        with h5py.File(compact_path, "r+") as file:
            file[group].attrs[name] = before
    Table.open(compact_path).verify()


@pytest.mark.parametrize(
    ("name", "array"),
    [
        (f"{LEVEL}/u_cov", np.zeros((1, 6), np.float32)),
        (f"{LEVEL}/log_balance", np.zeros(1, np.float32)),
        (f"{PATHS}/weight", np.zeros(1, np.float32)),
        (f"{PATHS}/sequence", np.zeros(1, np.int32)),
    ],
)
def test_fields_of_former_versions_are_refused_beside(compact_path: Path, name: str, array: np.ndarray) -> None:
    with h5py.File(compact_path, "r+") as file:
        file[name] = array
    with pytest.raises(CorruptTableError, match=f"{name} does not belong to a table of this format version"):
        Table.open(compact_path)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        (f"{LEVEL}/u_root16", np.zeros((1, 6), np.float16)),
        (f"{LEVEL}/log_balance16", np.zeros(1, np.float16)),
        (f"{PATHS}/weight16", np.zeros(1, np.float16)),
    ],
)
def test_compact_fields_are_refused_in_former_versions(tmp_path: Path, name: str, array: np.ndarray) -> None:
    random_content(1).write(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "r+") as file:
        file[name] = array
    with pytest.raises(CorruptTableError, match=f"{name} does not belong to a table of this format version"):
        Table.open(tmp_path / "t.h5")
