"""The paper's method from a plain table: nearest cell, no correction for the angle within it.

The table has the paper's path prior. A station's mixture is that of the cell at its angle, in the level with the window
nearest to the stated standard deviation; the offset of the angle within its cell is not used. A propagation time
conditions the stored mixture over (position, path length), the paper's Algorithm 1 with its steps 3 and 4 exchanged;
then the stations' mixtures are multiplied and the arg max is taken, as in the paper. Algorithm 2 needs points and has
no equivalent, so relative times are refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.paper.mixtures import Mixture, arg_max, condition_on_last, multiply
from rayfix_evaluation.paper.reports import sort_for_paper
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.fusion.measurements.report import Report
from rayfix_tables.errors import ReportError
from rayfix_tables.level import Level
from rayfix_tables.mixture import joint_cov
from rayfix_tables.table import Table

_MOST_PRODUCTS = 1_000
"""Number of products of components that are kept after each station."""

_LEAST_WEIGHT = 1e-6
"""Components whose weight is below this fraction of the largest in their mixture are left out."""


@dataclass(frozen=True, kw_only=True)
class PlainTableLocator:
    """Locates reports from the nearest cells of a table."""

    table: Table

    def locate(self, report: Report) -> NDArray[np.float64] | None:
        """Position of shape (3,), m, or None if no ray arrives from the measured directions.

        Raises
        ------
        ReportError
            When the report has other data than angles and propagation times.
        """
        found = sort_for_paper(report, self.table.site)
        if found.reference is not None:
            raise ReportError("the paper's method from a plain table does not support relative times; leave them out")
        mixtures = []
        for name, direction in found.directions.items():
            mixture = self._mixture(self.table.levels(name), direction, found.ranges.get(name))
            if mixture is not None:
                mixtures.append(mixture)
        if not mixtures:
            return None
        return arg_max(mixtures, multiply(mixtures, _MOST_PRODUCTS).mean) + self.table.scene.origin

    def _mixture(
        self, levels: Sequence[Level], direction: Direction, measured: tuple[float, float] | None
    ) -> Mixture | None:
        """Mixture over the position from one station's nearest cell."""
        assert direction.azimuth is not None
        assert direction.zenith is not None
        stdev = float(np.linalg.det(direction.cov) ** 0.25)
        level = min(levels, key=lambda one: abs(np.log(one.window / stdev)))
        cell, _, _ = level.grid.cell_around(direction.azimuth, direction.zenith)
        tubes = level.cell(cell)
        if not len(tubes):
            return None
        joint = joint_mixture(level, cell)
        if measured is None:
            return _heavy(Mixture(log_weight=joint.log_weight, mean=joint.mean[:, :3], cov=joint.cov[:, :3, :3]))
        return _heavy(condition_on_last(joint, measured[0], measured[1] ** 2))


def joint_mixture(level: Level, cell: int) -> Mixture:
    """Mixture of a cell over (x, y, z, path length), m, the angles within the cell integrated out."""
    tubes = level.cell(cell)
    order = np.array([3, 4, 5, 0])
    return Mixture(
        log_weight=np.asarray(tubes.log_weight, np.float64),
        mean=np.column_stack([tubes.x_mean, tubes.u_mean[:, 0]]).astype(np.float64),
        cov=joint_cov(tubes)[:, order[:, None], order],
    )


def _heavy(mixture: Mixture) -> Mixture:
    keep = mixture.log_weight > mixture.log_weight.max() + np.log(_LEAST_WEIGHT)
    return Mixture(log_weight=mixture.log_weight[keep], mean=mixture.mean[keep], cov=mixture.cov[keep])
