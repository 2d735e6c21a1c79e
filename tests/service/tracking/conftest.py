"""Scenes and reports by hand.

Unless a test says otherwise the free space is a cube of 60 m about the origin without any surface. The sheet::

          z | /|
            |/ |        a single sheet x = 0, |y| < 5, |z| < 5: neither side is solid, and nothing passes it
        ----|--|---- x
            | /
"""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.posterior.fused import Fused
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import Prior, uniform_prior
from rayfix_service.tracking.likelihood import Likelihood, likelihood_of
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.scene import Scene

Array = NDArray[np.float64]

FREE = FreeSpace(origin=np.full(3, -30.0), voxel_size=1.0, free=np.ones((60, 60, 60), np.bool_))


def scene_of(triangles: Array, free_space: FreeSpace = FREE) -> Scene:
    """Make a scene of triangles of shape (n, 3, 3)."""
    count = len(triangles)
    return Scene(
        vertices=triangles.reshape(-1, 3),
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        face_materials=np.full(count, -1, np.int16),
        materials=(),
        free_space=free_space,
        sha256="0" * 64,
    )


def hypotheses_of(
    means: Sequence[Sequence[float]],
    stdev: float = 0.1,
    probabilities: Sequence[float] | None = None,
    log_all_outlier: float = -50.0,
) -> Hypotheses:
    """Make round Gaussians of which the log weights are the logarithms of the probabilities."""
    count = len(means)
    weights = np.array(probabilities or [1.0 / count] * count)
    return Hypotheses(
        log_weight=np.log(weights),
        mean=np.array(means, np.float64),
        cov=np.tile(stdev**2 * np.eye(3), (count, 1, 1)),
        outlier=np.zeros((count, 1), np.int8),
        log_all_outlier=log_all_outlier,
    )


def fused_of(
    hypotheses: Hypotheses | None,
    *,
    target: str | None = "t",
    timestamp: str | None = "2026-01-31T10:00:00Z",
    prior: Prior | None = None,
) -> Fused:
    """Make a report's product with a fix that holds no more than the tracker asks for."""
    log_evidence = 0.0
    if hypotheses is not None:
        log_evidence = float(np.logaddexp.reduce([*hypotheses.log_weight, hypotheses.log_all_outlier]))
    fix = Fix(
        status="ok",
        candidates=(),
        outcomes=(),
        log_evidence=log_evidence,
        table_id="0" * 64,
        target_id=target,
        timestamp=timestamp,
    )
    return Fused(fix=fix, hypotheses=hypotheses, prior=prior or uniform_prior(FREE), likelihood=hypotheses)


@pytest.fixture
def free_space() -> FreeSpace:
    """Cube of 60 m."""
    return FREE


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    """Return the function that makes scenes."""
    return scene_of


@pytest.fixture
def make_hypotheses() -> Callable[..., Hypotheses]:
    """Return the function that makes hypotheses."""
    return hypotheses_of


@pytest.fixture
def even_likelihood() -> Callable[..., Likelihood]:
    """Return the function that makes likelihoods from what :func:`hypotheses_of` takes."""
    return lambda *a: likelihood_of(hypotheses_of(*a), uniform_prior(FREE).log_volume)


@pytest.fixture
def make_fused() -> Callable[..., Fused]:
    """Return the function that makes products of reports."""
    return fused_of


@pytest.fixture
def open_scene() -> Scene:
    """Free space without a surface."""
    return scene_of(np.empty((0, 3, 3)))


@pytest.fixture
def sheet_scene() -> Scene:
    """Free space cut in two by a sheet without thickness, as far as 5 m from the origin."""
    corners = np.array([[0.0, -5.0, -5.0], [0.0, 5.0, -5.0], [0.0, 5.0, 5.0], [0.0, -5.0, 5.0]])
    return scene_of(corners[[[0, 1, 2], [0, 2, 3]]])
