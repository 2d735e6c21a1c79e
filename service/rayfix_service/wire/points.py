"""Points and matrices on the wire."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

Matrix = Annotated[list[Annotated[list[float], Field(min_length=3, max_length=3)]], Field(min_length=3, max_length=3)]
"""Three rows of three numbers."""


class Point(BaseModel):
    """A position in the scene frame, m."""

    x: float
    y: float
    z: float


def point(position: NDArray[np.float64]) -> dict[str, float]:
    """Write a position of shape (3,), m."""
    x, y, z = position.tolist()
    return {"x": x, "y": y, "z": z}
