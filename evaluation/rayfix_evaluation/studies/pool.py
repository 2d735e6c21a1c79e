"""Parallel runs in processes; results do not depend on their number."""

import os
import pickle
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from rayfix_evaluation.studies.bench import Bench, BenchSettings
from rayfix_evaluation.studies.cases import Case
from rayfix_evaluation.studies.summary import Run
from rayfix_tables.errors import RayfixError

__all__ = ["Done", "Task", "end_with", "run_tasks"]

_CHUNK = 10
"""Number of drops that a process receives at a time."""

_WATCH_SECONDS = 1.0
"""Largest time until a process notices that its parent has ended, s."""

_bench: Bench | None = None


@dataclass(frozen=True, kw_only=True)
class Task:
    """A method applied to drops of a case.

    Attributes
    ----------
    drops : tuple of int
        Numbers of the drops.
    """

    case: Case
    method: str
    drops: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Done:
    """A finished task.

    Attributes
    ----------
    seconds : ndarray of shape (n_drops,)
        Processor time of each answer.
    """

    task: Task
    run: Run
    seconds: NDArray[np.float64]


def run_tasks(
    settings: BenchSettings, tasks: Sequence[Task], *, jobs: int, advance: Callable[[str, int], None]
) -> Iterator[Done]:
    """Run tasks and yield each as it is finished, in any order.

    Parameters
    ----------
    jobs : int
        Processes; -1 for one per core. With 1, everything runs in this process.
    advance : callable
        Called with a method and the number of drops that it has located since the last call.

    Raises
    ------
    RayfixError
        When a process ends before its work is done.
    """
    jobs = effective_n_jobs(jobs)
    if jobs == 1:
        bench = Bench(settings)
        with threadpool_limits(limits=1):
            for task in tasks:
                run, seconds = bench.run(task.case, task.method, task.drops)
                advance(task.method, len(task.drops))
                yield Done(task=task, run=run, seconds=seconds)
        return
    parallel = Parallel(
        n_jobs=jobs,
        backend="loky",
        return_as="generator_unordered",
        batch_size=1,
        pre_dispatch="all",
        max_nbytes=None,
        initializer=_start,
        initargs=(pickle.dumps(settings), os.getpid()),
    )
    try:
        yield from _gathered(parallel, tasks, advance)
    except BrokenProcessPool as error:
        raise RayfixError(
            "a process of the evaluation ended early, as it does when memory runs out; run the same command again "
            "with fewer --jobs: finished work is kept"
        ) from error


def _gathered(parallel: Parallel, tasks: Sequence[Task], advance: Callable[[str, int], None]) -> Iterator[Done]:
    """Run the tasks in chunks of a few drops, and combine the results."""
    pieces = [
        (number, begin, task.drops[begin : begin + _CHUNK])
        for number, task in enumerate(tasks)
        for begin in range(0, len(task.drops), _CHUNK)
    ]
    missing = Counter(number for number, _, _ in pieces)
    parts: dict[int, dict[int, tuple[Run, NDArray[np.float64]]]] = defaultdict(dict)
    calls = (delayed(_run)(n, begin, tasks[n].case, tasks[n].method, drops) for n, begin, drops in pieces)
    for number, begin, run, seconds in parallel(calls):
        task = tasks[number]
        parts[number][begin] = run, seconds
        missing[number] -= 1
        advance(task.method, len(seconds))
        if not missing[number]:
            found = [part for _, part in sorted(parts.pop(number).items(), key=lambda item: item[0])]
            joined = Run.joined([run for run, _ in found])
            yield Done(task=task, run=joined, seconds=np.concatenate([seconds for _, seconds in found]))


def end_with(process: int) -> None:
    """End this process when its parent has ended for any reason, because nothing receives the results.

    Parameters
    ----------
    process : int
        Process number of the parent.
    """

    def watch() -> None:
        while os.getppid() == process:
            time.sleep(_WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _start(settings: bytes, parent: int) -> None:
    """Prepare a process of the pool."""
    global _bench
    end_with(parent)
    threadpool_limits(limits=1)
    _bench = Bench(pickle.loads(settings))


def _run(
    number: int, begin: int, case: Case, method: str, drops: tuple[int, ...]
) -> tuple[int, int, Run, NDArray[np.float64]]:
    assert _bench is not None
    return number, begin, *_bench.run(case, method, drops)
