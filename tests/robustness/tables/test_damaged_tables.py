"""Tables that are damaged or made to harm: refused in one line, within limits, by everything that reads tables."""

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from benchmarks.robustness.flips import faults_of, flip_bits, flipped, peak_bytes_of_children
from rayfix.cli import main
from rayfix.example.files import write_example
from rayfix_tables import checked
from rayfix_tables.checked import CheckLimits, open_checked
from rayfix_tables.errors import CorruptTableError, NotATableError, TableError
from rayfix_tables.table import Table
from tests.support.checkout import ROOT
from tests.support.tables.random_tables import random_content
from tests.support.tables.table_edits import change_site, sign

HANGS = [(2985, 3), (3225, 3)]
"""Bits of the former table below with which HDF5 2.0 is busy for ever, among the texts of attributes."""

CIRCLES = [(8339, 6), (18315, 7), (20747, 6)]
"""Bits with which it finds the members of a group again and again."""

LEVEL = "stations/bs0/levels/0"
FORMER_TABLE = ROOT / "tests/tables/stored/format-1.h5"
SHORT = CheckLimits(seconds=1.0)


@pytest.fixture
def table_path(tmp_path: Path) -> Path:
    """Return the path of a table of 40 kB; its bytes are always the same."""
    path = tmp_path / "small.h5"
    random_content(1, num_stations=1, num_levels=1).write(path)
    return path


@pytest.fixture
def former_table_path(tmp_path: Path) -> Path:
    """Return the path of a copy of that table as format 1 had it: its texts are in a heap without checksums."""
    return Path(shutil.copy(FORMER_TABLE, tmp_path / "former.h5"))


def refused_in_a_line(path: Path, *, kind: type[TableError] = CorruptTableError) -> str:
    """Check that a file is refused, and return the line."""
    with pytest.raises(kind) as caught:
        open_checked(path, limits=SHORT)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def hanging() -> bytes:
    """Content of a table that HDF5 reads for ever."""
    place, bit = HANGS[0]
    return flipped(FORMER_TABLE.read_bytes(), place, bit)


def check_flips(table: Path, *, seed: int, count: int) -> None:
    """Flip bits and check that each file is refused in a line or is the same table, or that its check was ended."""
    outcomes = flip_bits(table, seed=seed, count=count)
    assert len(outcomes) == count
    assert faults_of(table, outcomes) == []
    assert 0.2 * count < sum(not outcome.accepted for outcome in outcomes) < 0.95 * count


def test_flipped_bits_of_a_former_table_are_found_or_change_nothing(former_table_path: Path) -> None:
    check_flips(former_table_path, seed=1, count=200)


def test_no_flipped_bit_keeps_hdf5_busy(table_path: Path) -> None:
    """The texts are in the objects themselves, and HDF5's own structures have checksums."""
    content = table_path.read_bytes()
    assert b"GCOL" not in content  # a global heap
    assert b"SNOD" not in content  # a symbol table, which has no checksum
    assert b"GCOL" in FORMER_TABLE.read_bytes()
    assert {outcome.status for outcome in flip_bits(table_path, seed=8, count=300)} == {0}


@pytest.mark.slow
def test_a_thousand_flipped_bits_are_found_or_change_nothing(table_path: Path) -> None:
    check_flips(table_path, seed=2, count=1000)  # benchmarks/robustness/flips.py flips more, of any seed


@pytest.mark.parametrize(("place", "bit"), HANGS)
def test_a_table_that_is_read_for_ever_is_refused(former_table_path: Path, place: int, bit: int) -> None:
    former_table_path.write_bytes(flipped(former_table_path.read_bytes(), place, bit))
    message = refused_in_a_line(former_table_path)
    if h5py.version.hdf5_version == "2.0.0":
        assert "reading it takes more than 1 s of processor time" in message


@pytest.mark.parametrize(("place", "bit"), CIRCLES)
def test_a_group_without_end_is_refused(former_table_path: Path, place: int, bit: int) -> None:
    former_table_path.write_bytes(flipped(former_table_path.read_bytes(), place, bit))
    refused_in_a_line(former_table_path)


def commands(table: Path, folder: Path) -> list[list[str]]:
    """Commands that read a table."""
    site, report, output = folder / "site" / "site.toml", folder / "site" / "report.json", folder / "out"
    return [
        ["info", str(table)],
        ["verify", str(table)],
        ["serve", str(table), "--port", "0", "--check-seconds", "1"],
        ["locate", str(table), str(report)],
        ["view", str(table), "-o", f"{output}.html"],
        ["plot", str(table), str(report), "-o", f"{output}.png"],
        ["plan", str(table), "-o", f"{output}.png", "--height", "1"],
        ["build", str(site), "-o", f"{output}.h5", "--former", str(table), "--no-progress"],
        ["evaluate", str(site), "-o", str(output), "--table", str(table), "--no-progress"],
    ]


def test_every_command_refuses_a_table_that_is_read_for_ever(
    table_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_example(tmp_path / "site")
    table_path.write_bytes(hanging())
    monkeypatch.setattr(checked, "_DEFAULT_LIMITS", SHORT)
    for command in commands(table_path, tmp_path):
        assert main(command) == 2, command
        line = capsys.readouterr().err
        assert line.startswith(f"rayfix: {table_path} is damaged: "), command
        assert line.count("\n") == 1, command


def test_a_build_over_a_damaged_table_goes_on_and_says_so(
    table_path: Path, tmp_path: Path, hall_site_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rayfix_offline.job.method import Method
    from rayfix_offline.job.previous_table import read_former

    table_path.write_bytes(hanging())
    monkeypatch.setattr(checked, "_DEFAULT_LIMITS", SHORT)
    said: list[str] = []
    assert read_former(table_path, Method(), required=False, refused=said.append) is None
    (line,) = said
    assert line.startswith(f"the existing table is not reused: {table_path} is damaged: ")
    assert read_former(tmp_path / "none.h5", Method(), required=False, refused=said.append) is None
    assert len(said) == 1


def replaced(file: h5py.File, name: str, make: Callable[[h5py.Group, str, Any], Any]) -> None:
    """Put something else with the same checksum in the place of a dataset."""
    values, digest = file[name][()], file[name].attrs["sha256"]
    del file[name]
    group, _, last = name.rpartition("/")
    make(file[group], last, values)
    if isinstance(file.get(name, getlink=True), h5py.HardLink):
        file[name].attrs["sha256"] = digest


def soft_link(group: h5py.Group, name: str, values: Any) -> None:
    group[f"{name}_elsewhere"] = values
    group[name] = h5py.SoftLink(f"{group.name}/{name}_elsewhere")


def link_to_another(group: h5py.Group, name: str, values: Any) -> None:
    group[name] = h5py.SoftLink(f"{group.name}/x_mean")


def external_link(group: h5py.Group, name: str, values: Any) -> None:
    group[name] = h5py.ExternalLink("other.h5", "/data")


def external_storage(group: h5py.Group, name: str, values: Any) -> None:
    group.create_dataset(name, values.shape, values.dtype, external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])


def virtual(group: h5py.Group, name: str, values: Any) -> None:
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource("other.h5", "data", shape=values.shape)
    group.create_virtual_dataset(name, layout)


def chunked(group: h5py.Group, name: str, values: Any) -> None:
    group.create_dataset(name, data=values, chunks=True)


def compressed(group: h5py.Group, name: str, values: Any) -> None:
    group.create_dataset(name, data=values, compression="gzip")


def huge_and_compressed(group: h5py.Group, name: str, values: Any) -> None:
    """4 GB in 100 kB."""
    group.create_dataset(name, (1 << 28, *values.shape[1:]), values.dtype, chunks=True, compression="gzip", fillvalue=1)


def huge_and_never_written(group: h5py.Group, name: str, values: Any) -> None:
    group.create_dataset(name, (1 << 40, *values.shape[1:]), values.dtype)


def of_objects(group: h5py.Group, name: str, values: Any) -> None:
    group.create_dataset(name, (len(values),), h5py.string_dtype())


def twice(group: h5py.Group, name: str, values: Any) -> None:
    group[name] = values
    group[f"{name}_again"] = group[name]


def a_cycle(group: h5py.Group, name: str, values: Any) -> None:
    group[name] = values
    group["cycle"] = group


def a_named_type(group: h5py.Group, name: str, values: Any) -> None:
    group[name] = np.dtype("f4")


TRICKS = [
    (soft_link, "is a link; a table has none"),
    (link_to_another, "is a link; a table has none"),
    (external_link, "is a link; a table has none"),
    (external_storage, "is not stored contiguously without a filter"),
    (virtual, "is not stored contiguously without a filter"),
    (chunked, "is not stored contiguously without a filter"),
    (compressed, "is not stored contiguously without a filter"),
    (huge_and_compressed, "is not stored contiguously without a filter"),
    (huge_and_never_written, "is incomplete"),
    (of_objects, "is object with 1 axes"),
    (twice, "is in the file twice"),
    (a_cycle, "is in the file twice"),
    (a_named_type, "does not belong to a table"),
]


@pytest.mark.parametrize("name", ["scene/vertices_m", f"{LEVEL}/x_mean"])
@pytest.mark.parametrize(("trick", "reason"), TRICKS)
def test_what_rayfix_never_writes_is_refused_before_it_is_read(
    table_path: Path, trick: Callable[[h5py.Group, str, Any], Any], reason: str, name: str
) -> None:
    """A soft link, for one, may show another dataset to the reader than to the checksums."""
    with h5py.File(table_path, "r+") as file:
        replaced(file, name, trick)
    assert reason in refused_in_a_line(table_path).replace("_elsewhere", "").replace("_again", "")
    with pytest.raises(CorruptTableError):
        Table.open(table_path)
    assert peak_bytes_of_children() < 2e9


@pytest.mark.parametrize("name", ["more", "scene/more", "stations/bs0/more", f"{LEVEL}/more", "stations/bs7/levels/0"])
def test_members_that_a_table_does_not_have_are_refused(table_path: Path, name: str) -> None:
    with h5py.File(table_path, "r+") as file:
        file.create_group(name)
    refused_in_a_line(table_path)


@pytest.mark.parametrize(
    "value", [np.zeros(5000), np.zeros((2, 2)), h5py.Empty("f8"), np.nan, [b"a", b"b"], "x" * 60_000]
)
def test_attributes_are_texts_and_short_rows_of_numbers(table_path: Path, value: Any) -> None:
    with h5py.File(table_path, "r+") as file:
        file["stations/bs0"].attrs["part_id"] = value
    refused_in_a_line(table_path)


def put_values(path: Path, name: str, values: Any) -> None:
    """Replace values, and make checksums and ``table_id`` right again."""
    with h5py.File(path, "r+") as file:
        file[name][...] = values
        sign(file)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("scene/faces", lambda v: np.full_like(v, 2_000_000_000)),
        ("scene/faces", lambda v: np.full_like(v, -1)),
        ("scene/face_materials", lambda v: np.full_like(v, 9)),
        ("scene/face_materials", lambda v: np.full_like(v, -2)),
        ("scene/vertices_m", lambda v: np.full_like(v, np.nan)),
        ("scene/free_space", lambda v: np.full_like(v, 2)),
        (f"{LEVEL}/ring_cells", lambda v: np.full_like(v, -5)),
        (f"{LEVEL}/ring_cells", lambda v: np.full_like(v, np.iinfo(np.int64).max)),
        (f"{LEVEL}/cell_offsets", lambda v: np.concatenate([v[:1], v[2:3] + 2**62, v[2:]])),
        (f"{LEVEL}/cell_log_mass", lambda v: np.full_like(v, np.inf)),
        (f"{LEVEL}/x_mean", lambda v: np.full_like(v, -np.inf)),
        (f"{LEVEL}/log_balance", lambda v: np.full_like(v, np.nan)),
    ],
)
def test_numbers_that_kernels_cannot_have_are_refused_though_the_checksums_are_right(
    table_path: Path, name: str, change: Callable[[Any], Any]
) -> None:
    with h5py.File(table_path) as file:
        values = change(file[name][()])
    put_values(table_path, name, values)
    assert name in refused_in_a_line(table_path)
    with pytest.raises(CorruptTableError, match=name):
        Table.open(table_path)


def test_texts_that_no_answer_can_hold_are_refused(table_path: Path) -> None:
    """Half of a surrogate pair is JSON, and cannot be written as UTF-8: it would fail each answer and figure."""
    with h5py.File(table_path, "r+") as file:
        change_site(file, lambda site: site | {"name": "\ud800"})
    refused_in_a_line(table_path)


def test_what_is_no_regular_file_is_never_opened(table_path: Path, tmp_path: Path) -> None:
    """To open a named pipe waits for whoever writes to it, which may be nobody."""
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "folder.h5").mkdir()
    (tmp_path / "dangling.h5").symlink_to("nothing")
    (tmp_path / "circle.h5").symlink_to("circle.h5")
    (tmp_path / "device.h5").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket.h5"))
    kinds = {"pipe": "a named pipe", "folder": "a folder", "dangling": "a symbolic link to nothing"}
    kinds["circle"] = "a symbolic link that leads back to itself"
    for name, what in {**kinds, "device": "a device", "socket": "a socket"}.items():
        path = tmp_path / f"{name}.h5"
        assert what in refused_in_a_line(path, kind=NotATableError)
        with pytest.raises(NotATableError):
            Table.open(path)
    (tmp_path / "link.h5").symlink_to(table_path)
    assert open_checked(tmp_path / "link.h5").table_id == Table.open(table_path).table_id


def test_a_checked_table_is_the_table_and_needs_no_hdf5(table_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = Table.open(table_path)
    monkeypatch.setattr(h5py, "File", None)
    for whole in (True, False):
        table = open_checked(table_path, whole=whole)
        table.verify()
        assert (table.table_id, table.site, table.parts.keys()) == (
            expected.table_id,
            expected.site,
            expected.parts.keys(),
        )
        for (name, ours), (_, theirs) in zip(table.arrays(), expected.arrays(), strict=True):
            np.testing.assert_array_equal(ours, theirs, err_msg=name)


def test_a_module_of_the_present_folder_takes_no_part_in_the_check(
    table_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('not this one')")
    monkeypatch.chdir(tmp_path)
    assert open_checked(table_path).verify() is None
