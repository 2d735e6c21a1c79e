"""Ending a fix that is under way, from another thread.

A thread cannot be ended from outside. Kernels therefore read a cell every few milliseconds and return early once it
is set. Their result is then meaningless, so that their callers check the cell as well and raise.
"""

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.errors import RayfixError


class FixStoppedError(RayfixError):
    """A fix was stopped before it was complete."""


class Stop:
    """Stops a fix that is under way.

    Attributes
    ----------
    cell : ndarray of uint8, shape (1,)
        What kernels read: not 0 once the fix is to end.
    """

    def __init__(self) -> None:
        self.cell: NDArray[np.uint8] = np.zeros(1, np.uint8)

    def set(self) -> None:
        """Stop the fix; may be called from any thread."""
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
"""For fixes that nothing stops; it is never set."""
