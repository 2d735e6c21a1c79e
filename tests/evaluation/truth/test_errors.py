"""Meshes and arguments that the image method refuses."""

import numpy as np
import pytest

from rayfix_tables.errors import SceneError
from tests.support.oracles.forward_paths import solver_of
from tests.support.scenes.shapes import quad


def test_meshes_that_cannot_be_used() -> None:
    with pytest.raises(SceneError, match="no triangle with an area"):
        solver_of(np.array([[[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]]))
    with pytest.raises(SceneError, match="not finite"):
        solver_of(np.array([[[0.0, 0, 0], [1, np.nan, 1], [2, 2, 0]]]))


def test_arguments_that_cannot_be_used() -> None:
    floor = quad((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0))
    with pytest.raises(ValueError, match="max_reflections is -1"):
        solver_of(floor, max_reflections=-1)
    with pytest.raises(ValueError, match="max_path_length is nan"):
        solver_of(floor, max_path_length=float("nan"))
    with pytest.raises(ValueError, match="the point is"):
        solver_of(floor).paths((0, 0, 1), (0, np.inf, 1))
    with pytest.raises(ValueError, match="the station is"):
        solver_of(floor).line_of_sight((0, 0), [(0, 0, 1)])
