"""Runs spread over processes; results do not depend on their number."""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from rayfix_evaluation.studies.bench import Bench, BenchSettings
from rayfix_evaluation.studies.cases import Case
from rayfix_evaluation.studies.summary import Run
from rayfix_tables.errors import RayfixError

__all__ = ["Done", "Task", "end_with_parent", "run_tasks"]

_CHUNK = 10
"""Drops that a process gets at a time."""

_bench: Bench | None = None


@dataclass(frozen=True, kw_only=True)
class Task:
    """A method on the drops of a case.

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
        Processor time that each answer took.
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
        Processes; -1 for one per core. With 1, everything happens in this one.
    advance : callable
        Called with a method and the number of drops that it has located since the last call.

    Raises
    ------
    RayfixError
        When a process ends before its work is done.
    """
    jobs = (os.cpu_count() or 1) if jobs == -1 else jobs
    if not tasks:
        return
    if jobs == 1:
        bench = Bench(settings)
        with threadpool_limits(limits=1):
            for task in tasks:
                run, seconds = bench.run(task.case, task.method, task.drops)
                advance(task.method, len(task.drops))
                yield Done(task=task, run=run, seconds=seconds)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=_start, initargs=(settings,)) as pool:
        try:
            yield from _spread(pool, tasks, advance)
        except BrokenProcessPool as error:
            raise RayfixError(
                "a process of the evaluation ended early, as it does when memory runs out; run the same command again "
                "with fewer --jobs: finished work is kept"
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _spread(pool: ProcessPoolExecutor, tasks: Sequence[Task], advance: Callable[[str, int], None]) -> Iterator[Done]:
    missing: list[int] = []
    parts: list[list[tuple[Run, NDArray[np.float64]] | None]] = []
    futures: dict[Future[tuple[Run, NDArray[np.float64]]], tuple[int, int, int]] = {}
    for number, task in enumerate(tasks):
        chunks = [task.drops[begin : begin + _CHUNK] for begin in range(0, len(task.drops), _CHUNK)]
        missing.append(len(chunks))
        parts.append([None] * len(chunks))
        for place, chunk in enumerate(chunks):
            futures[pool.submit(_run, task.case, task.method, chunk)] = (number, place, len(chunk))
    for future in as_completed(futures):
        number, place, count = futures[future]
        parts[number][place] = future.result()
        missing[number] -= 1
        advance(tasks[number].method, count)
        if not missing[number]:
            found = [part for part in parts[number] if part is not None]
            parts[number] = []
            run = Run.joined([run for run, _ in found])
            yield Done(task=tasks[number], run=run, seconds=np.concatenate([seconds for _, seconds in found]))


def end_with_parent() -> None:
    """End this process when the one that started it has ended, however that was: nobody waits for its results then."""

    def watch() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _start(settings: BenchSettings) -> None:
    global _bench
    end_with_parent()
    threadpool_limits(limits=1)
    _bench = Bench(settings)


def _run(case: Case, method: str, drops: tuple[int, ...]) -> tuple[Run, NDArray[np.float64]]:
    assert _bench is not None
    return _bench.run(case, method, drops)
