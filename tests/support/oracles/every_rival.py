"""All rivals of a table's site."""

import numpy as np

from rayfix_evaluation.baselines.fingerprints import Fingerprinting
from rayfix_evaluation.baselines.line_of_sight import LineOfSight
from rayfix_evaluation.baselines.planar import PlanarPredecessor
from rayfix_evaluation.baselines.reverse_rays import ReverseRays
from rayfix_tables.table import Table
from tests.support.oracles.rival_protocol import Rival


def every_rival(
    table: Table, *, height: float | None = None, map_spacing: float = 0.5, seed: int = 1
) -> tuple[Rival, ...]:
    """Make all rivals for a table's scene and stations.

    Parameters
    ----------
    height : float, m, optional
        z of the transmitter for the 2D predecessor where a report does not say it.
    map_spacing : float, m
        Of the map of fingerprints.
    seed : int
        Of the rivals that draw.
    """
    vertices = np.asarray(table.scene.vertices, np.float64)
    bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    return (
        PlanarPredecessor.of_table(table, height=height, seed=seed),
        ReverseRays.of_table(table),
        LineOfSight(site=table.site, bounds=bounds, kinds=("angles",)),
        LineOfSight(site=table.site, bounds=bounds, kinds=("ranges",)),
        LineOfSight(site=table.site, bounds=bounds, kinds=("differences",)),
        LineOfSight(site=table.site, bounds=bounds, kinds=("angles", "ranges", "differences"), robust=True),
        Fingerprinting.of_table(table, spacing=map_spacing),
    )
