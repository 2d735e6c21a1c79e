"""Processes that compile the same kernels wait for each other."""

import fcntl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from numba.core import event

from rayfix_tables.gaussians.kernel_lock import KernelLock

EVENT = event.Event("numba:compiler_lock", event.EventStatus.START)

KERNEL = """
import sys, numba
from pathlib import Path
from numba.core import event
from rayfix_tables.gaussians.kernel_lock import KernelLock

@numba.njit
def two(x):
    return x + x

event.register("numba:compiler_lock", KernelLock(Path(sys.argv[1])))
print("begin", flush=True)
print(two(3), flush=True)
print(two(1.5), flush=True)
"""


@pytest.fixture
def compiling(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a process that compiles under the lock in a folder."""
    command = [sys.executable, "-c", KERNEL, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


def test_a_process_waits_for_another_one(tmp_path: Path, compiling: subprocess.Popen[str]) -> None:
    with (tmp_path / "kernels.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert compiling.stdout is not None
        assert compiling.stdout.readline() == "begin\n"
        time.sleep(1.5)  # in which it would have compiled
        assert compiling.poll() is None
        told = time.monotonic()
    assert compiling.stdout.readline() == "6\n"
    assert time.monotonic() >= told
    assert compiling.stdout.readline() == "3.0\n"
    assert compiling.wait(60) == 0


def is_held(folder: Path) -> bool:
    with (folder / "kernels.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False


def test_the_lock_is_held_until_the_outermost_end(tmp_path: Path) -> None:
    lock = KernelLock(tmp_path)
    lock.on_end(EVENT)  # of what began before it listened
    for _ in range(2):
        lock.on_start(EVENT)
        lock.on_start(EVENT)  # of a kernel that another one calls
        assert is_held(tmp_path)
        lock.on_end(EVENT)
        assert is_held(tmp_path)
        lock.on_end(EVENT)
        assert not is_held(tmp_path)


def test_threads_wait_for_each_other(tmp_path: Path) -> None:
    lock, order = KernelLock(tmp_path), []
    lock.on_start(EVENT)

    def other() -> None:
        lock.on_start(EVENT)
        order.append("other")
        lock.on_end(EVENT)

    thread = threading.Thread(target=other)
    thread.start()
    thread.join(0.2)
    order.append("this")
    lock.on_end(EVENT)
    thread.join(60.0)
    assert order == ["this", "other"]
    assert not is_held(tmp_path)


def test_where_there_can_be_no_lock_nobody_waits(tmp_path: Path) -> None:
    lock = KernelLock(tmp_path / "none")
    lock.on_start(EVENT)
    lock.on_end(EVENT)


def test_the_lock_is_in_the_first_folder_that_can_be_written_to(tmp_path: Path) -> None:
    lock = KernelLock(tmp_path / "none", tmp_path)
    lock.on_start(EVENT)
    assert is_held(tmp_path)
    lock.on_end(EVENT)
    assert not is_held(tmp_path)
