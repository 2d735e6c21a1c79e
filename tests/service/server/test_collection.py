"""The collector looks at old objects while no request is under way."""

import asyncio
import gc
from collections.abc import Iterator

import pytest

from rayfix_service.http.telemetry.request_context import UnderWay
from rayfix_service.server.collection import collect_while_idle


@pytest.fixture(autouse=True)
def collector() -> Iterator[None]:
    """Leave the collector as it was."""
    before = gc.get_threshold()
    yield
    gc.unfreeze()
    gc.set_threshold(*before)


@pytest.mark.parametrize(("busy", "latest", "collects"), [(0, 1000.0, True), (2, 1000.0, False), (2, 0.05, True)])
def test_old_objects_wait_for_an_idle_moment(busy: int, latest: float, collects: bool) -> None:
    """A collection in the midst of a long batch took 45 ms."""
    calls, under_way = [], UnderWay()

    async def scenario() -> None:
        task = asyncio.create_task(
            collect_while_idle(
                under_way, rest_seconds=0.005, latest_seconds=latest, collect=lambda: calls.append(gc.collect())
            )
        )
        await asyncio.sleep(0.02)
        assert gc.get_threshold()[2] > 1_000_000
        assert gc.get_freeze_count() > 0
        for _ in range(busy):
            under_way.begin()
        await asyncio.sleep(0.02)  # the collection that waited already
        calls.clear()
        gc.collect(1)  # something may have grown old
        await asyncio.sleep(0.3)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(scenario())
    assert bool(calls) is collects


def test_the_end_of_the_last_request_is_an_idle_moment() -> None:
    """One client that asks again and again leaves moments that a look every second does not meet."""
    calls, under_way = [], UnderWay()

    async def scenario() -> None:
        under_way.begin()
        under_way.begin()
        task = asyncio.create_task(
            collect_while_idle(under_way, rest_seconds=0.001, collect=lambda: calls.append(gc.collect()))
        )
        await asyncio.sleep(0.05)
        under_way.end()
        await asyncio.sleep(0.05)
        calls.clear()
        gc.collect(1)  # something may have grown old
        under_way.end()
        under_way.begin()
        await asyncio.sleep(0.05)
        task.cancel()

    asyncio.run(scenario())
    assert calls


def test_nothing_is_collected_where_nothing_has_grown_old(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gc, "get_count", lambda: (0, 0, 0))  # other threads of this process may allocate much
    calls: list[int] = []

    async def scenario() -> None:
        task = asyncio.create_task(
            collect_while_idle(UnderWay(), rest_seconds=0.001, collect=lambda: calls.append(gc.collect()))
        )
        await asyncio.sleep(0.1)
        task.cancel()

    asyncio.run(scenario())
    assert len(calls) == 1  # the first, before all is exempt
