"""Processes that locate blocks of a log, in order and with no more blocks under way than are needed.

The process that reads and writes needs no kernel: what locates is imported by those that do, which spares it the
memory of a compiler.
"""

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from multiprocessing import get_context
from typing import TYPE_CHECKING

from rayfix.logs.entries import Located, Problem, Task, Work, shard_of
from rayfix_tables.errors import RayfixError

if TYPE_CHECKING:
    from rayfix.logs.locating import LogLocator

BLOCK = 64
"""Entries that a process takes at a time."""

_UNDER_WAY = 3
"""Blocks of each process that are under way."""

Result = Located | Problem


def located(works: Iterable[Work | Problem], task: Task, jobs: int) -> Iterator[list[Result]]:
    """Locate the entries of a log; gives blocks of results in the order of the entries.

    Parameters
    ----------
    works : iterable of Work or Problem
        Problems are handed on in their place.
    task : Task
    jobs : int
        Processes. With 1, everything happens in this one, and so does a log of no more than one block.

    Raises
    ------
    RayfixError
        When a process ends early, and what the entries raise.
    """
    blocks = _blocks(works)
    first = next(blocks, [])
    second = next(blocks, None)
    if jobs < 2 or second is None:
        locator = _log_locator(task)
        for block in _chain(first, second, blocks):
            yield _merged(block, locator.block([w for w in block if isinstance(w, Work)]))
        return
    with ExitStack() as stack:
        context = get_context("spawn")  # a fork would take over the locks of this process's threads
        pools = [
            ProcessPoolExecutor(max_workers=1, mp_context=context, initializer=_start, initargs=(task, os.getpid()))
            for _ in range(jobs)
        ]
        for pool in pools:
            stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        try:
            yield from _in_order(_chain(first, second, blocks), pools, by_target=task.track)
        except BrokenProcessPool as error:
            raise RayfixError(
                "a process that located reports ended early, as it does when memory runs out; give fewer --jobs"
            ) from error


_Parts = list[tuple[list[int], Future[list[Result]]]]
"""Indices of the entries that a process has been given, and its answer."""


def _in_order(
    blocks: Iterable[list[Work | Problem]], pools: Sequence[ProcessPoolExecutor], *, by_target: bool
) -> Iterator[list[Result]]:
    waiting: deque[tuple[list[Work | Problem], _Parts]] = deque()
    for number, block in enumerate(blocks):
        waiting.append((block, _submit(block, number, pools, by_target=by_target)))
        if len(waiting) >= _UNDER_WAY * len(pools):
            yield _gathered(*waiting.popleft())
    while waiting:
        yield _gathered(*waiting.popleft())


def _submit(
    block: list[Work | Problem], number: int, pools: Sequence[ProcessPoolExecutor], *, by_target: bool
) -> _Parts:
    """Give a block to one process, or the reports of each target to that of the target."""
    indices: dict[int, list[int]] = {}
    for n, work in enumerate(block):
        if isinstance(work, Work):
            chosen = shard_of(_target(work)) if by_target else number
            indices.setdefault(chosen % len(pools), []).append(n)
    return [
        (mine, pools[k].submit(_locate, [work for n in mine if isinstance(work := block[n], Work)]))
        for k, mine in indices.items()
    ]


def _target(work: Work) -> str | None:
    report = work.entry.report
    assert not isinstance(report, bytes), "reports of tracks are read before they are given to a process"
    return report.target_id


def _gathered(block: list[Work | Problem], parts: _Parts) -> list[Result]:
    found: dict[int, Result] = {}
    for mine, answer in parts:
        found |= zip(mine, answer.result(), strict=True)
    return [work if isinstance(work, Problem) else found[n] for n, work in enumerate(block)]


def _merged(block: list[Work | Problem], results: list[Result]) -> list[Result]:
    answers = iter(results)
    return [work if isinstance(work, Problem) else next(answers) for work in block]


def _blocks(works: Iterable[Work | Problem]) -> Iterator[list[Work | Problem]]:
    block: list[Work | Problem] = []
    for work in works:
        block.append(work)
        if len(block) == BLOCK:
            yield block
            block = []
    if block:
        yield block


def _chain(
    first: list[Work | Problem], second: list[Work | Problem] | None, blocks: Iterator[list[Work | Problem]]
) -> Iterator[list[Work | Problem]]:
    yield first
    if second is not None:
        yield second
        yield from blocks


_locator: "LogLocator | None" = None


def _log_locator(task: Task) -> "LogLocator":
    from rayfix.logs.locating import LogLocator

    return LogLocator(task)


def _start(task: Task, parent: int) -> None:
    """Prepare a process: it ends with the one that started it, and leaves interruptions to that."""
    global _locator
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    _locator = _log_locator(task)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _locate(block: list[Work]) -> list[Result]:
    assert _locator is not None
    return _locator.block(block)
