"""Progress on standard error: bars on a terminal, otherwise a line every few seconds."""

import resource
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TaskProgressColumn, TextColumn
from rich.text import Text

if TYPE_CHECKING:
    from rayfix_offline.build import Progress as BuildProgress

_LINE_SECONDS = 10.0
"""Time between two lines without a terminal."""

_TABLE_STAGES = ("reading the scene", "balancing", "writing")
"""Stages of a build in addition to those of stations and levels."""

Show = Callable[[str, int, int], None]


@contextmanager
def build_progress(*, enabled: bool) -> "Iterator[BuildProgress | None]":
    """Show stage, rate, remaining time and memory on standard error."""
    if not enabled:
        yield None
        return
    with _build_bar() if sys.stderr.isatty() else _lines() as show:
        yield show


@contextmanager
def _build_bar() -> Iterator[Show]:
    bar = Progress(
        TextColumn("{task.description:<20}"),
        BarColumn(bar_width=12),
        TaskProgressColumn(),
        _RateColumn(),
        _TimesColumn(),
        _MemoryColumn(),
        console=Console(stderr=True),
    )
    unknown = bar.add_task("starting", total=None, begin=time.monotonic(), ended=None)
    known = bar.add_task("starting", total=None, visible=False, begin=time.monotonic(), ended=None)

    def show(stage: str, done: int, total: int) -> None:
        bar.start()
        if not total:
            bar.update(unknown, description=stage, visible=True)
            bar.update(known, visible=False)
            return
        if total != bar.tasks[1].total:
            bar.reset(known)  # rates of different stages are not comparable
        bar.update(known, description=stage, completed=done, total=total, visible=True)
        bar.update(unknown, visible=False)

    with _stopped(bar, known):
        yield show


@contextmanager
def stage_progress(*, enabled: bool) -> Iterator[Show]:
    """Show each stage of a long job and its remaining time on standard error."""
    if not enabled:
        yield lambda stage, done, total: None
        return
    with _stage_bars() if sys.stderr.isatty() else _lines() as show:
        yield show


@contextmanager
def _stage_bars() -> Iterator[Show]:
    bar = Progress(
        TextColumn("{task.description:<24}"),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        _TimesColumn(),
        console=Console(stderr=True),
    )
    tasks: dict[str, TaskID] = {}
    current: TaskID | None = None

    def show(stage: str, done: int, total: int) -> None:
        nonlocal current
        # A build reports stages by station and level; one bar shows them all.
        name = "building tables" if ":" in stage or stage in _TABLE_STAGES else stage
        bar.start()
        if name not in tasks:
            tasks[name] = bar.add_task(name, total=None, begin=time.monotonic(), ended=None)
        if current is not None and current != tasks[name]:
            bar.update(current, ended=time.monotonic())
        current = tasks[name]
        if total:
            bar.update(current, completed=done, total=total, ended=None)

    with _stopped(bar, None):
        yield show


@contextmanager
def _stopped(bar: Progress, known: TaskID | None) -> Iterator[None]:
    """Stop a bar at the end; stopping one that was never shown would print an empty line.

    After a failure before the amount of work is known, such as a mistake in the scene, only the message is shown.
    """
    try:
        yield
    except BaseException:
        bar.live.transient = known is not None and not bar.tasks[known].visible
        raise
    finally:
        if bar.live.is_started:
            for task in bar.tasks:
                bar.update(task.id, ended=task.fields["ended"] or time.monotonic())
            bar.stop()


@contextmanager
def _lines() -> Iterator[Show]:
    """Write a line on the current stage at regular intervals, even without new reports."""
    begin, ended = time.monotonic(), threading.Event()
    latest = ("starting", 0, 0)

    def show(stage: str, done: int, total: int) -> None:
        nonlocal latest
        latest = (stage, done, total)

    def write() -> None:
        while not ended.wait(_LINE_SECONDS):
            stage, done, total = latest
            fraction = f" {done / total:.0%}" if total else ""
            print(f"{stage}{fraction}, {_clock(time.monotonic() - begin)}", file=sys.stderr, flush=True)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    try:
        yield show
    finally:
        ended.set()
        writer.join()


class _RateColumn(ProgressColumn):
    """Cells per second."""

    def render(self, task: Task) -> Text:
        cells = ":" in task.description
        return Text(f"{task.speed:,.0f} cells/s" if task.speed and cells else "", justify="right")


class _TimesColumn(ProgressColumn):
    """Elapsed time of the whole job, and remaining time of the stage."""

    def render(self, task: Task) -> Text:
        ended: float | None = task.fields["ended"]
        gone = _clock((ended or time.monotonic()) - task.fields["begin"])
        left = None if task.finished or ended is not None else task.time_remaining
        return Text(gone if left is None else f"{gone}, {_clock(left)} left")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


class _MemoryColumn(ProgressColumn):
    """Peak memory of the process."""

    def render(self, task: Task) -> Text:
        return Text(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9:.1f} GB")
