"""Answers with many results are sent piece by piece."""

import asyncio
import json
from typing import Any

import pytest

from rayfix_service.http.routes.json_answer import ResultsAnswer


async def sent(answer: ResultsAnswer) -> tuple[list[dict[str, Any]], int]:
    """Return the messages that an answer sends, and how often other tasks ran meanwhile."""
    messages: list[dict[str, Any]] = []
    turns = 0

    async def send(message: Any) -> None:
        messages.append(message)

    async def receive() -> Any:
        raise AssertionError

    async def others() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    task = asyncio.create_task(others())
    await answer({"type": "http"}, receive, send)
    task.cancel()
    return messages, turns


@pytest.mark.parametrize(("count", "size", "pieces"), [(0, 0, 1), (1, 5, 1), (3, 200_000, 4), (1000, 30_000, 334)])
def test_pieces_of_an_answer(count: int, size: int, pieces: int) -> None:
    """Results of 30 MB that were joined held the event loop for tens of milliseconds."""
    results = [json.dumps({"n": n, "text": size * "x"}).encode() for n in range(count)]
    (start, *bodies), turns = asyncio.run(sent(ResultsAnswer(results)))
    body = b"".join(message["body"] for message in bodies)
    assert json.loads(body) == {"results": [json.loads(result) for result in results]}
    headers = dict(start["headers"])
    assert headers[b"content-type"] == b"application/json"
    assert int(headers[b"content-length"]) == len(body)
    assert [message.get("more_body", False) for message in bodies] == [True] * (len(bodies) - 1) + [False]
    assert len(bodies) == pieces + 1
    assert max(len(message["body"]) for message in bodies) < 2 * (1 << 16) + size
    assert turns >= pieces - 1
