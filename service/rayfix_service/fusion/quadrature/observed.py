"""Turn an observation into what the kernel evaluates at positions."""

import math

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.directions import Direction, MeasuredAngles
from rayfix_service.fusion.measurements.line_of_sight import LineOfSightWeights, line_of_sight_weights
from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.product.factor_kernels import ALL_GOOD
from rayfix_service.fusion.product.factors import any_time, kinds_of
from rayfix_service.fusion.product.unmodelled import NO_PATH, unmodelled_path
from rayfix_service.fusion.quadrature.factor import PathFactor
from rayfix_service.fusion.settings import FusionSettings

_NO_INDICATION = LineOfSightWeights(0.0, 0.0)
_SCENE = np.eye(3)

_POLE = 1e-4
"""Measured zeniths are at least this far from the poles, rad: there the density of directions would be infinite."""


def path_factor(
    observation: Observation, settings: FusionSettings, max_path_length: float, station: NDArray[np.float64]
) -> PathFactor:
    """Measurements of one path as the kernel takes them; the times must not depend on a clock.

    Parameters
    ----------
    max_path_length : float, m
        A time that is an outlier may be anything up to this, and noise.
    station : ndarray of shape (3,), m
        Position in the frame of the path map.
    """
    kinds, _, log_outlier = kinds_of(observation, settings.outlier_probability, max_path_length)
    indicated = observation.los_probability
    weights = _NO_INDICATION if indicated is None else line_of_sight_weights(indicated, settings.sight_error)
    turn, zenith, cov = measured_direction(observation.direction)
    lengths = [kind[1:4] for kind in kinds if kind.outlier == ALL_GOOD]
    any_log = any_time(observation, max_path_length)
    path = unmodelled_path(observation, lengths, station, any_log, settings)
    log_good = math.log1p(-settings.outlier_probability - (path.probability if path else 0.0))
    return PathFactor(
        turn=turn,
        zenith=zenith,
        cov=cov,
        spreads=np.array([[math.exp(log_good + each.log_weight), each.scale] for each in observation.angle_spreads]),
        kinds=np.array(
            [[kind.outlier, math.exp(kind.log_weight), kind.length, kind.length_variance] for kind in kinds]
        ),
        direct=math.exp(weights.log_direct),
        reflected=math.exp(weights.log_reflected),
        outlier=math.exp(log_outlier),
        unmodelled=NO_PATH if path is None else path,
    )


def measured_direction(direction: Direction) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return ``turn``, ``zenith`` and ``cov`` of :class:`.factor.PathFactor` for a direction, or for none."""
    angles = _angles(direction)
    azimuth = 0.0 if angles is None else angles.azimuth
    to_measured = _about_z(-azimuth) @ (_SCENE if angles is None else angles.to_scene.T)
    zenith = math.nan if angles is None or angles.zenith is None else min(max(angles.zenith, _POLE), math.pi - _POLE)
    cov = direction.cov if angles is None else angles.cov
    return np.ascontiguousarray(to_measured), zenith, np.array([cov[0, 0], cov[0, 1], cov[1, 1]])


def _angles(direction: Direction) -> MeasuredAngles | None:
    """Angles as they were measured, None where none was."""
    if direction.local is not None:
        return direction.local
    if direction.azimuth is None:
        return None
    return MeasuredAngles(direction.azimuth, direction.zenith, direction.cov, _SCENE)


def _about_z(angle: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
