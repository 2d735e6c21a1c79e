"""Ending a fix that is under way, from another thread.

A thread cannot be ended from outside. Kernels therefore look at a cell every few milliseconds and return early once it
is set; what they return then is of no use, so that their callers look at it too, and raise.
"""

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.errors import RayfixError


class FixStoppedError(RayfixError):
    """A fix that was told to end before it was done."""


class Stop:
    """Tells a fix that is under way to end.

    Attributes
    ----------
    cell : ndarray of uint8, shape (1,)
        What kernels look at: not 0 once the fix is to end.
    """

    def __init__(self) -> None:
        self.cell: NDArray[np.uint8] = np.zeros(1, np.uint8)

    def set(self) -> None:
        """Tell it to end; may be called from any thread."""
        self.cell[0] = 1

    def check(self) -> None:
        """Raise once the fix is to end.

        Raises
        ------
        FixStoppedError
        """
        if self.cell[0]:
            raise FixStoppedError("the fix was stopped before it was done; send fewer measurements or allow more time")


NEVER = Stop()
"""Of fixes that nothing stops. Nobody sets it."""
