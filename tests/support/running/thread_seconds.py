"""Processor time, as little as possible of what else the machine does."""

import gc
from collections.abc import Callable
from time import thread_time


def fastest_thread_seconds(work: Callable[[], object], runs: int) -> float:
    """Return the processor time of this thread that the fastest of several runs takes, s.

    The collector rests, as with ``timeit``: its time grows with what other tests have left in memory.
    """
    taken = []
    collects = gc.isenabled()
    gc.disable()
    try:
        for _ in range(runs):
            begin = thread_time()
            work()
            taken.append(thread_time() - begin)
    finally:
        if collects:
            gc.enable()
    return min(taken)
