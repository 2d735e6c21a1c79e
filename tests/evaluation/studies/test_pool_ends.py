"""Processes of an evaluation: they do not outlive it, and one that ends early is one clear error."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor

from rayfix_evaluation.studies.bench import BenchSettings
from rayfix_evaluation.studies.cases import Case
from rayfix_evaluation.studies.pool import Done, Task, run_tasks
from rayfix_tables.errors import RayfixError

PARENT = """
import os, time
from joblib import Parallel, delayed
from rayfix_evaluation.studies.pool import end_with

def work():
    print(os.getpid(), flush=True)
    time.sleep(600)

if __name__ == "__main__":
    pool = Parallel(n_jobs=2, backend="loky", batch_size=1, initializer=end_with, initargs=(os.getpid(),))
    pool(delayed(work)() for _ in range(2))
"""


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT, encoding="utf-8")
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(parent.stdout.readline()) for _ in range(2)]
        assert all(is_alive(worker) for worker in workers)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    deadline = time.monotonic() + 60.0
    while any(map(is_alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(is_alive, workers))


def run(table: Path, drops: int, jobs: int, kill: bool = False) -> list[Done]:
    """Locate drops by one method; kill all workers after the first piece, if so wanted."""

    def advance(method: str, count: int) -> None:
        if kill:
            for pid in list(get_reusable_executor(reuse=True)._processes):
                os.kill(pid, signal.SIGKILL)

    settings = BenchSettings(tables={"site": table}, seed=7, drops=drops)
    task = Task(case=Case(), method="los-angles", drops=tuple(range(drops)))
    try:
        return list(run_tasks(settings, [task], jobs=jobs, advance=advance))
    finally:
        if jobs > 1:
            get_reusable_executor().shutdown(wait=True, kill_workers=True)


@pytest.mark.slow
def test_the_results_do_not_depend_on_the_number_of_processes(hall_table_path: Path) -> None:
    (one,), (two,) = run(hall_table_path, 25, 1), run(hall_table_path, 25, 2)
    assert one.task == two.task
    assert one.run.document() == two.run.document()
    assert len(one.seconds) == len(two.seconds) == 25


@pytest.mark.slow
def test_a_process_that_ends_early_is_one_clear_error(hall_table_path: Path) -> None:
    with pytest.raises(RayfixError, match=r"ended early, as it does when memory runs out.*fewer --jobs"):
        run(hall_table_path, 200, 2, kill=True)
