"""Short runs of ``benchmarks.robustness.climb`` and ``kills``, the same each time."""

import itertools
import os
import time
from pathlib import Path

import pytest

from benchmarks.robustness import kills
from benchmarks.robustness.climb import Answered, Message, all_searches, climb, fault_of
from rayfix_service.locator import Locator
from rayfix_tables.table import Table
from tests.support.running.running_app import RunningApp
from tests.support.tables.hand_tables import line_of_sight, table_of

PATIENCE = 30.0
"""Besides the service's own limits, s: the machine has other work."""


def test_a_short_climb_towards_costly_messages(hall_table_path: Path):
    faults: list[str | None] = []
    statuses = set()
    with RunningApp(hall_table_path) as app:

        def send(message: Message) -> Answered:
            kind = "text/plain" if message.path.endswith("ublox") else "application/json"
            begin = time.perf_counter()
            status = app.post_bytes(message.path, message.body, {"content-type": kind}).status_code
            # Its length stands for what it costs, lest the messages depend on the machine.
            answer = Answered(status=status, seconds=time.perf_counter() - begin, processor=len(message.body), wall=0.0)
            faults.append(fault_of(message, answer, PATIENCE))
            statuses.add(status)
            return answer

        steps = itertools.count()
        climb(send, all_searches(Locator(Table.open(hall_table_path)), 5), goes_on=lambda: next(steps) < 20)
        assert app.get("/livez").status_code == 200
    assert len(faults) == 80
    assert set(faults) == {None}
    assert {200, 422} <= statuses


def test_a_few_kills_and_bad_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TMPDIR", os.environ.get("TMPDIR", "/tmp"))  # it is set for the service, and set back here
    (tmp_path / "attack").mkdir()
    table = table_of(tmp_path / "hand.h5", *(line_of_sight(station) for station in "abc")).path
    assert kills.run(table, tmp_path / "attack", counts=(3, 1, 2), seed=3, limit=PATIENCE, seconds=300.0) == []
