"""The bundled hall as the image method takes it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix.example.hall import hall_scene
from rayfix_evaluation.truth.forward import ForwardSolver
from tests.support.oracles.forward_paths import solver_of

Array = NDArray[np.float64]


@pytest.fixture(scope="session")
def hall_triangles() -> Array:
    mesh = hall_scene().to_geometry()
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


@pytest.fixture(scope="session")
def hall(hall_triangles: Array) -> ForwardSolver:
    return solver_of(hall_triangles)
