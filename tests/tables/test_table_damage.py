"""Files that are no table, or no longer one: one line that names the file and the remedy."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rayfix_tables.disk.layout import damage_reported
from rayfix_tables.disk.schema import LEVEL_DATASETS, SCENE_DATASETS, TEXT_DATASETS, write_text
from rayfix_tables.errors import CorruptTableError, FormatVersionError, NotATableError, TableError
from rayfix_tables.table import Table
from tests.support.messages.refusals import refusal
from tests.support.tables.changed_bytes import content_digest, outcomes_of_changes
from tests.support.tables.table_edits import put_text

REBUILD = "restore it from a copy or build it again"
LEVEL = "stations/bs1/levels/1"
DATASETS = [*SCENE_DATASETS, *TEXT_DATASETS, *(f"{LEVEL}/{name}" for name in LEVEL_DATASETS)]
ATTRIBUTES = [
    ("/", "table_id"),
    ("/", "software_version"),
    ("/", "scene_sha256"),
    ("scene/free_space", "origin_m"),
    ("scene/free_space", "voxel_size_m"),
    ("stations/bs0", "position_m"),
    ("stations/bs0", "orientation_deg"),
    ("stations/bs0", "field_of_view_deg"),
    ("stations/bs0", "lost_ray_share"),
    ("stations/bs0", "coverage"),
    (LEVEL, "window_deg"),
]


def refused(path: Path, kind: type[TableError], remedy: str, *, read: Callable[[Path], Any] = Table.open) -> str:
    """Check that a file is refused for this reason, exactly, in one line; return that line."""
    message = refusal(kind, read, path)
    assert remedy in message
    return message


def verified(path: Path) -> None:
    """Open a table and check its checksums."""
    Table.open(path).verify()


def put_attribute(group: h5py.Group, name: str, value: Any) -> None:
    """Write an attribute as tables have them: texts of fixed length."""
    if isinstance(value, str):
        write_text(group, name, value)
    else:
        group.attrs[name] = value


def test_a_missing_file(tmp_path: Path) -> None:
    path = tmp_path / "none.h5"
    assert refused(path, TableError, f"rayfix build SITE.toml -o {path}").startswith("there is no table")


def test_a_folder(tmp_path: Path) -> None:
    refused(tmp_path, NotATableError, "give a file that 'rayfix build' wrote")


@pytest.mark.parametrize("content", [b"", b"[site]\nname = 'hall'\n", b"\x89HDF", bytes(4096)])
def test_not_an_hdf5_file(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "t.h5"
    path.write_bytes(content)
    assert "not an HDF5 file" in refused(path, NotATableError, "give a file that 'rayfix build' wrote")


def test_another_programs_hdf5_file(tmp_path: Path) -> None:
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as file:
        file["data"] = np.arange(5)
    assert "HDF5 file but not a rayfix table" in refused(path, NotATableError, "give a file that 'rayfix build' wrote")


@pytest.mark.parametrize("version", [0, 6, 99, "1", -1])
def test_another_format_version(small_table_path: Path, version: int | str) -> None:
    with h5py.File(small_table_path, "r+") as file:
        file.attrs["format_version"] = version
    message = refused(small_table_path, FormatVersionError, "build the table again with this version")
    assert f"table format {version}" in message


def test_a_format_version_that_is_missing(small_table_path: Path) -> None:
    with h5py.File(small_table_path, "r+") as file:
        del file.attrs["format_version"]
    refused(small_table_path, FormatVersionError, "build the table again")


def test_a_truncated_table(small_table_path: Path) -> None:
    """Below the first 8 bytes nothing tells that it was an HDF5 file."""
    raw = small_table_path.read_bytes()
    for length in (0, 1, 7):
        small_table_path.write_bytes(raw[:length])
        refused(small_table_path, NotATableError, "give a file that 'rayfix build' wrote")
    for length in (8, 50, 96, 100, 800, 2048, 5000, len(raw) // 2, len(raw) - 100, len(raw) - 1):
        small_table_path.write_bytes(raw[:length])
        refused(small_table_path, CorruptTableError, REBUILD)
    small_table_path.write_bytes(raw[: len(raw) // 2])
    refused(small_table_path, CorruptTableError, "is cut short; ")
    small_table_path.write_bytes(raw)
    verified(small_table_path)


def test_a_longer_file_is_still_the_table(small_table_path: Path) -> None:
    """HDF5 knows where its content ends."""
    with small_table_path.open("ab") as file:
        file.write(b"more")
    verified(small_table_path)


@pytest.mark.parametrize("name", DATASETS)
def test_a_missing_dataset(small_table_path: Path, name: str) -> None:
    with h5py.File(small_table_path, "r+") as file:
        del file[name]
    refused(small_table_path, CorruptTableError, REBUILD)


@pytest.mark.parametrize(("group", "name"), ATTRIBUTES)
def test_a_missing_attribute(small_table_path: Path, group: str, name: str) -> None:
    with h5py.File(small_table_path, "r+") as file:
        del file[group].attrs[name]
    refused(small_table_path, CorruptTableError, REBUILD)


@pytest.mark.parametrize("group", ["scene", "stations", "stations/bs0", "stations/bs0/levels", "stations/bs0/levels/0"])
def test_a_missing_group(small_table_path: Path, group: str) -> None:
    with h5py.File(small_table_path, "r+") as file:
        del file[group]
    refused(small_table_path, CorruptTableError, REBUILD)


BALANCE = "stations/bs1/levels/0/log_balance"


def test_a_missing_balance_is_found_by_its_checksum(small_table_path: Path) -> None:
    """Without one, a level is as tables before it had it; this table is not that."""
    with h5py.File(small_table_path, "r+") as file:
        del file[BALANCE]
    assert len(Table.open(small_table_path).parts["bs1"].levels[0].log_balance) == 0
    refused(small_table_path, CorruptTableError, "the table_id does not match", read=verified)


@pytest.mark.parametrize("name", [BALANCE, *(n for n in DATASETS if n != "scene/free_space")])
def test_a_dataset_of_another_length(small_table_path: Path, name: str) -> None:
    """Of another length than the rest, or of another type: an answer from it would be nonsense."""
    with h5py.File(small_table_path, "r+") as file:
        shorter = file[name][:-1]
        del file[name]
        file[name] = shorter
    reader = verified if name.startswith("scene") else Table.open
    refused(small_table_path, CorruptTableError, REBUILD, read=reader)


@pytest.mark.parametrize("name", DATASETS)
def test_a_dataset_of_another_type(small_table_path: Path, name: str) -> None:
    with h5py.File(small_table_path, "r+") as file:
        values = file[name][()]
        del file[name]
        file[name] = values.astype(np.complex64)
    refused(small_table_path, CorruptTableError, REBUILD)


@pytest.mark.parametrize(
    "site",
    ["", "[]", "{", "7", "null", '"site"', '{"station_ids": []}', '{"station_ids": ["nobody"]}', '{"station_ids": 3}'],
)
def test_a_site_that_is_not_one(small_table_path: Path, site: str) -> None:
    with h5py.File(small_table_path, "r+") as file:
        put_text(file, "site", site)
    refused(small_table_path, CorruptTableError, REBUILD)


@pytest.mark.parametrize("materials", ["5", '"concrete"', "[5]", "["])
def test_materials_that_are_none(small_table_path: Path, materials: str) -> None:
    with h5py.File(small_table_path, "r+") as file:
        put_text(file, "scene/materials", materials)
    refused(small_table_path, CorruptTableError, REBUILD)


@pytest.mark.parametrize("error", [TypeError, AttributeError, AssertionError, IndexError, ZeroDivisionError])
def test_defects_of_the_reader_are_no_damage_of_the_file(tmp_path: Path, error: type[Exception]) -> None:
    with pytest.raises(error, match="a defect"), damage_reported(tmp_path / "t.h5"):
        raise error("a defect")


def test_texts_in_a_heap_are_refused(small_table_path: Path) -> None:
    """HDF5 reads some damaged heaps for ever; a table of this format has none."""
    with h5py.File(small_table_path, "r+") as file:
        file["stations/bs0"].attrs["part_id"] = "of variable length"
    assert "part_id is neither a text nor a number" in refused(small_table_path, CorruptTableError, REBUILD)


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("stations/bs0", "position_m", np.zeros(2)),
        ("stations/bs0", "position_m", "here"),
        ("stations/bs0", "coverage", 0.5),
        ("stations/bs0", "lost_ray_share", "few"),
        ("stations/bs0", "range_bias_m", np.zeros(3)),
        ("stations/bs0", "part_id", 5),
        ("scene", "origin_m", 3.0),
        (LEVEL, "window_deg", "wide"),
        ("scene/free_space", "origin_m", "origin"),
    ],
)
def test_an_attribute_of_another_type(small_table_path: Path, group: str, name: str, value: Any) -> None:
    with h5py.File(small_table_path, "r+") as file:
        put_attribute(file[group], name, value)
    refused(small_table_path, CorruptTableError, REBUILD)


def test_offsets_that_do_not_ascend(small_table_path: Path) -> None:
    for change in (lambda o: o[::-1], lambda o: np.concatenate([o[:3], [o[2] - 1], o[4:]]), lambda o: o + 1):
        with h5py.File(small_table_path, "r+") as file:
            offsets = file[f"{LEVEL}/cell_offsets"]
            before = offsets[()]
            offsets[...] = change(before)
        assert "cell_offsets" in refused(small_table_path, CorruptTableError, REBUILD)
        with h5py.File(small_table_path, "r+") as file:
            file[f"{LEVEL}/cell_offsets"][...] = before
    verified(small_table_path)


# What only the checksums find


@pytest.mark.parametrize("name", DATASETS)
def test_one_flipped_bit_in_a_dataset(small_table_path: Path, name: str) -> None:
    with h5py.File(small_table_path) as file:
        offset, size = file[name].id.get_offset(), file[name].nbytes
    raw = bytearray(small_table_path.read_bytes())
    raw[offset + size // 2] ^= 0x01
    small_table_path.write_bytes(raw)
    message = refused(small_table_path, CorruptTableError, REBUILD, read=verified)
    # Of indices, and of what is then no number or no JSON, it is said before the checksums are compared.
    assert f"the checksum of {name} does not match" in message or f"{name} " in message


@pytest.mark.parametrize(
    ("group", "name", "change"),
    [
        ("/", "table_id", lambda v: "0" * 64),
        ("/", "scene_sha256", lambda v: "0" * 64),
        ("scene/free_space", "voxel_size_m", lambda v: np.nextafter(v, 1)),
        ("stations/bs0", "position_m", lambda v: np.nextafter(v, 99)),
        ("stations/bs1", "orientation_deg", lambda v: np.nextafter(v, 999)),
        ("stations/bs1", "field_of_view_deg", lambda v: np.nextafter(v, 999)),
        ("stations/bs1", "lost_ray_share", lambda v: np.nextafter(v, 1)),
        ("stations/bs1", "coverage", lambda v: np.nextafter(v, 1)),
        (LEVEL, "window_deg", lambda v: np.nextafter(v, 99)),
    ],
)
def test_one_changed_attribute(small_table_path: Path, group: str, name: str, change: Callable[[Any], Any]) -> None:
    with h5py.File(small_table_path, "r+") as file:
        value = file[group].attrs[name]
        put_attribute(file[group], name, change(value.decode() if isinstance(value, bytes) else value))
    assert "table_id" in refused(small_table_path, CorruptTableError, REBUILD, read=verified)


def test_a_rewritten_checksum_does_not_hide_a_change(small_table_path: Path, make_content: Callable[..., Any]) -> None:
    other = small_table_path.with_name("other.h5")
    make_content(2).write(other)
    with h5py.File(small_table_path, "r+") as file, h5py.File(other) as donor:
        del file["scene/vertices_m"]
        donor.copy("scene/vertices_m", file["scene"])
    assert "table_id" in refused(small_table_path, CorruptTableError, REBUILD, read=verified)


def test_an_added_dataset(small_table_path: Path) -> None:
    with h5py.File(small_table_path, "r+") as file:
        file["more"] = np.arange(3)
    refused(small_table_path, CorruptTableError, REBUILD, read=verified)


def test_a_changed_software_version_is_no_damage(small_table_path: Path) -> None:
    with h5py.File(small_table_path, "r+") as file:
        write_text(file, "software_version", "9.9")
    verified(small_table_path)
    assert Table.open(small_table_path).software_version == "9.9"


def test_a_changed_byte_anywhere_is_found_or_has_no_effect(
    small_table_path: Path, make_content: Callable[..., Any], tmp_path: Path
) -> None:
    """HDF5's own administration fails in many ways; each is a damaged table, and none changes an answer unseen.

    Some releases of HDF5 crash on a few of these files.
    """
    path = tmp_path / "t.h5"
    make_content(1, num_stations=1, num_levels=1).write(small_table_path)
    expected = content_digest(Table.open(small_table_path))
    places = range(3, small_table_path.stat().st_size, 101)
    outcomes = outcomes_of_changes(small_table_path, path, places)
    problems = [outcome.problem for outcome in outcomes if outcome.problem is not None]
    digests = [outcome.digest for outcome in outcomes if outcome.digest is not None]
    assert all(str(path) in problem and "\n" not in problem for problem in problems)
    assert set(digests) <= {expected}
    assert len(problems) > 0.4 * len(places)
    assert len(places) - len(problems) - len(digests) < 0.01 * len(places)


@pytest.mark.slow
def test_the_hall_table_is_whole_and_a_change_is_found(hall_table_copy: Path, hall_table_path: Path) -> None:
    Table.open(hall_table_path).verify()
    with h5py.File(hall_table_copy) as file:
        offset = file["stations/bs2/levels/0/u_root16"].id.get_offset()
    with hall_table_copy.open("r+b") as file:
        file.seek(offset + 4)
        byte = file.read(1)[0]
        file.seek(offset + 4)
        file.write(bytes([byte ^ 1]))
    table = Table.open(hall_table_copy)
    with pytest.raises(CorruptTableError, match="the checksum of stations/bs2/levels/0/u_root16 does not match"):
        table.verify()
    shutil.copy(hall_table_path, hall_table_copy)
    Table.open(hall_table_copy).verify()


def test_too_little_memory_is_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "t.h5"
    with pytest.raises(TableError, match="not enough memory") as caught, damage_reported(path):
        raise MemoryError
    assert not isinstance(caught.value, CorruptTableError)
