"""A search for modes that is stopped at any moment leaves everything in its place."""

from typing import Any

import numpy as np
import pytest

from rayfix_service.fusion.posterior import modes
from rayfix_service.fusion.posterior.saddles import unite_maxima


class StopsAfter:
    """Like the cell of a ``Stop`` that is set once it was looked at a number of times."""

    def __init__(self, looks: int) -> None:
        self.left = looks

    def __getitem__(self, index: int) -> int:
        """Look at it."""
        self.left -= 1
        return int(self.left < index)


class UsedMemory:
    """NumPy where new arrays of integers hold what was in memory before."""

    def __getattr__(self, name: str) -> Any:
        """Return what NumPy has of that name, but for this."""
        return self.empty if name == "empty" else getattr(np, name)

    def empty(self, shape: Any, dtype: Any = np.float64) -> Any:
        """Return an array of which nothing is known."""
        return np.full(shape, 10**6, dtype)


def ripple(count: int) -> tuple[Any, Any, Any]:
    """Hypotheses in a row, in random order, each a maximum that is connected to its neighbours."""
    rng = np.random.default_rng(5)
    mean = np.zeros((count, 3))
    mean[:, 0] = rng.permutation(3.2 * np.arange(count))
    return rng.uniform(-0.1, 0.0, count), mean, np.repeat(np.eye(3)[None], count, axis=0)


def test_without_a_stop_the_row_is_one_mode() -> None:
    top, member = modes.gather(*ripple(12), 9.0, 0.7, 64.0, np.zeros(1, np.uint8))
    assert len(top) == 1
    assert not member.any()


@pytest.mark.parametrize("looks", range(0, 90, 3))
def test_every_hypothesis_has_a_mode(monkeypatch: pytest.MonkeyPatch, looks: int) -> None:
    """Half-united maxima made indices of what was in memory before: the service crashed once in 200,000 reports."""
    modes.gather(*ripple(12), 9.0, 0.7, 64.0, np.zeros(1, np.uint8))  # compiles what is called below
    monkeypatch.setattr(modes, "np", UsedMemory())
    monkeypatch.setattr(modes, "unite_maxima", getattr(unite_maxima, "py_func", unite_maxima))
    gather = getattr(modes.gather, "py_func", modes.gather)
    top, member = gather(*ripple(12), 9.0, 0.7, 64.0, StopsAfter(looks))
    assert set(member.tolist()) == set(range(len(top)))
