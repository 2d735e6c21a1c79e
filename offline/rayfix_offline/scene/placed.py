"""An object of a scene with its place in it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Placed = tuple[str, Any, NDArray[np.float64]]
"""Name, mesh and transform of an object."""
