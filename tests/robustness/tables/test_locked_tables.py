"""Tables that other programs have locked, and errors of the system that are no damage of a file."""

import errno
import fcntl
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest

from rayfix_offline.build import build_table
from rayfix_offline.job.method import Method
from rayfix_offline.job.previous_table import read_former
from rayfix_tables.checked import open_checked
from rayfix_tables.disk.layout import damage_reported
from rayfix_tables.errors import CorruptTableError, TableError
from rayfix_tables.table import Table


@pytest.fixture
def locked(hall_table_copy: Path) -> Iterator[Path]:
    """Table on which a writer holds its lock."""
    with hall_table_copy.open("r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(BlockingIOError):
            h5py.File(hall_table_copy, "r", locking=True)
        yield hall_table_copy


def test_a_locked_table_is_read(locked: Path) -> None:
    Table.open(locked).verify()
    open_checked(locked)
    assert read_former(locked, Method(), required=True) is not None


def test_a_build_refuses_an_output_that_is_being_written(locked: Path, hall_site_path: Path) -> None:
    before = locked.read_bytes()
    with pytest.raises(TableError, match=r"copy\.h5: another program has locked it to write to it; end that"):
        build_table(hall_site_path, locked)
    assert locked.read_bytes() == before


def test_a_build_replaces_a_table_that_is_being_read(hall_table_copy: Path, hall_site_path: Path) -> None:
    with hall_table_copy.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        summary = build_table(hall_site_path, hall_table_copy)
    assert {station.origin for station in summary.stations} == {"kept"}


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ESTALE, errno.EIO, errno.EAGAIN])
def test_errors_of_the_system_are_no_damage(number: int) -> None:
    with (
        pytest.raises(TableError, match=r"t\.h5 cannot be read \(.+\); check that its disk") as caught,
        damage_reported(Path("t.h5")),
    ):
        raise OSError(number, "unable to lock file")
    assert not isinstance(caught.value, CorruptTableError)


def test_what_hdf5_cannot_make_sense_of_is_damage() -> None:
    for error, what in (
        (OSError("truncated file: eof = 96"), "is cut short"),
        (OSError(errno.EINVAL, "file read failed"), "is damaged"),
    ):
        with pytest.raises(CorruptTableError, match=what), damage_reported(Path("t.h5")):
            raise error
