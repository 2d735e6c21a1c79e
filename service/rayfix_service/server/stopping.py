"""Callbacks at the signal to end, before the server waits for open streams."""

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_DEFAULTS = (signal.SIG_DFL, signal.SIG_IGN, signal.default_int_handler, None)


@contextmanager
def on_stop_signal(callback: Callable[[], None]) -> Iterator[None]:
    """Call a function in the running loop at SIGINT or SIGTERM, in addition to the server's handler.

    A server that handles these signals stops listening and waits for requests in progress; a stream of events would
    continue until that wait times out. A signal without a handler remains without one.
    """
    loop = asyncio.get_running_loop()
    replaced: dict[signal.Signals, Any] = {}

    def chained(handler: Callable[[int, FrameType | None], Any]) -> Callable[[int, FrameType | None], None]:
        def handle(number: int, frame: FrameType | None) -> None:
            loop.call_soon_threadsafe(callback)
            handler(number, frame)

        return handle

    for number in (signal.SIGINT, signal.SIGTERM):
        handler = signal.getsignal(number)
        if callable(handler) and handler not in _DEFAULTS:
            try:
                signal.signal(number, chained(handler))
            except ValueError:  # not the main thread; only that receives signals
                break
            replaced[number] = handler
    try:
        yield
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)
