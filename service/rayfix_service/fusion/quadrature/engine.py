"""Locate reports whose errors are wide on the path map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rayfix_service.fusion.measurements.likelihood import log_normal_terms, spreads
from rayfix_service.fusion.measurements.observations import Observation, SortedReport
from rayfix_service.fusion.measurements.report import Angle, LogRange, Range, Report
from rayfix_service.fusion.posterior.summary import Summary
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.factor_kernels import ALL_GOOD, ALL_OUTLIER
from rayfix_service.fusion.product.outliers import OutlierIndex
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.quadrature.blocks import BlockTree, StationPaths
from rayfix_service.fusion.quadrature.grid import GridLimits, Leaves, integrate
from rayfix_service.fusion.quadrature.observed import path_factor
from rayfix_service.fusion.quadrature.reweighted import Reweighted
from rayfix_service.fusion.quadrature.sets import NO_SETS, PathSets, SortedPaths, StationSet
from rayfix_service.fusion.quadrature.summary import sum_up_leaves
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.level import WIDE_RATIO
from rayfix_tables.site import Selection
from rayfix_tables.table import Table

_FINEST_LENGTH = 0.05
"""Reports with a path length that is more accurate, m, are left to Gaussians: its shells are thin."""

_SETS_LIMITS = GridLimits(least_share=1e-3, resolution=0.3)
"""For sets of paths, whose information is added up as if all told of one direction."""

NO_SELECTIONS: Mapping[str, Selection] = {}
"""Of stations whose rules are the table's."""

_LEAST_RULES = 4
"""Rules of single stations whose weights are kept at least; twice the number of stations where that is more."""

_LEAST_SECONDS = 1e-3
"""What any fix takes, s."""

_FACTOR_SECONDS = 6e-4
"""What each measurement takes, s."""

_RANGES_ALONE = 3.0
"""By how much more a report of ranges alone takes, whose shells are wide and thin."""

_MANY_SHARE, _MANY_FROM = 0.2, 4
"""By how much more each measurement takes for each one beyond so many."""

_SETS_SECONDS, _PATH_SECONDS = 6e-3, 8e-4
"""What a report of several paths of a station takes, and each of them, s."""

_PREPARING_SECONDS = 1.5e-6
"""What working out the weights of a rule takes, for each path of a station's map, s."""

_POSITION = 3
"""Coordinates of a position: more numbers than that, of as many quantities, leave nothing open."""

_TELLING = 0.6
"""An angle whose error may be of a greater standard deviation, rad, leaves the direction open."""

_OPEN = 6.0
"""By how many times a fix takes longer where something is left open."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GridPosterior:
    """Posterior of a report on blocks of the free space.

    Attributes
    ----------
    leaves : Leaves
    log_all_outlier : float
        Log evidence of the case that all measurements are outliers, which the blocks' masses include.
    omitted : bool
        Whether blocks are larger than they should be, since there would be too many.
    """

    leaves: Leaves
    log_all_outlier: float
    omitted: bool

    def summary(self, index: OutlierIndex, free_space: FreeSpace, floor: float, stop: Stop = NEVER) -> Summary | None:
        """Sum the posterior up; ``floor`` is for posteriors of Gaussians."""
        del floor
        return sum_up_leaves(self.leaves, self.log_all_outlier, index, free_space, stop)

    def hypotheses(self) -> Hypotheses:
        """Return a Gaussian for each block, the best first, about as wide as its block."""
        leaves = self.leaves
        good = np.flatnonzero(leaves.untold < 1.0 - 1e-12)
        order = good[np.argsort(-leaves.log_mass[good], kind="stable")]
        half = 0.5 * np.stack([leaves.width[order], leaves.width[order], leaves.height[order]], axis=1)
        outlier = np.where(leaves.lost[order] > 0.5, ALL_OUTLIER, ALL_GOOD)
        return Hypotheses(
            log_weight=leaves.log_mass[order] + np.log1p(-leaves.untold[order]),
            mean=leaves.point[order],
            cov=half[:, :, None] ** 2 * np.eye(3),
            outlier=outlier.astype(np.int8),
            log_all_outlier=self.log_all_outlier,
        )


class Quadrature:
    """Integrates the posterior of reports, with what follows from a table and is worked out once.

    Parameters
    ----------
    table : Table
    settings : FusionSettings
    """

    def __init__(self, table: Table, settings: FusionSettings) -> None:
        self._table, self._settings = table, settings
        self._limits = GridLimits()
        self._tree: BlockTree | None = None
        self._stations: dict[str, StationPaths] = {}
        self._reweighted = Reweighted(most=max(_LEAST_RULES, 2 * len(table.parts)))

    def suits(self, report: SortedReport, selections: Mapping[str, Selection] = NO_SELECTIONS) -> bool:
        """Whether a report is to be located here, where no clock is unknown.

        All of its errors are wide, or a station's rule is not the table's, which cells of Gaussians cannot follow.
        """
        observations = report.observations
        if not observations or report.num_clocks:
            return False
        if selections:
            return all(self._has_paths(each.station_id) for each in observations)
        return all(map(self._is_wide, observations))

    def _has_paths(self, name: str) -> bool:
        paths = self._table.parts[name].paths
        return paths is not None and len(paths) > 0

    def _is_wide(self, observation: Observation) -> bool:
        if not self._has_paths(observation.station_id):
            return False
        part = self._table.parts[observation.station_id]
        if any(term.variance < _FINEST_LENGTH**2 for terms in observation.lengths for term in terms):
            return False
        return _narrowest(observation) > WIDE_RATIO * part.levels[0].window

    def seconds(self, report: Report, selections: Mapping[str, Selection] = NO_SELECTIONS) -> float | None:
        """Estimate how long a fix will take here, s; None for a report that Gaussians answer.

        A report that leaves the position open along a line or a surface takes long, as does one of many combinations of
        errors.
        """
        known, combinations = {("", "height")} if report.height is not None else set[tuple[str, str]](), 1
        for m in report.measurements:
            part = self._table.parts.get(m.station_id)
            if part is None or part.paths is None or not isinstance(m, Angle | Range | LogRange):
                return None
            if isinstance(m, Angle):
                stdevs = [m.azimuth_stdev] if m.zenith_stdev is None else [m.azimuth_stdev, m.zenith_stdev]
                if not selections and min(stdevs) <= WIDE_RATIO * part.levels[0].window:
                    return None
                of_angles = zip(("azimuth", "zenith"), stdevs, strict=False)
                scales = [spread.scale for spread in spreads(m.error_model)]
                known |= {(m.station_id, name) for name, stdev in of_angles if max(scales) * stdev < _TELLING}
                combinations += len(scales) - 1
            else:
                if not selections and isinstance(m, Range) and m.stdev < _FINEST_LENGTH:
                    return None
                known.add((m.station_id, "length"))
                combinations += _num_terms(m) - 1
        slow = 1.0 if len(known) > _POSITION else _OPEN
        if not any(isinstance(m, Angle) for m in report.measurements):
            slow = max(slow, _RANGES_ALONE)
        new = [name for name, rule in selections.items() if not self._reweighted.has_selected(name, rule)]
        # Where many contradict each other, there are many places to resolve.
        many = 1.0 + _MANY_SHARE * max(len(report.measurements) - _MANY_FROM, 0)
        fix = _LEAST_SECONDS + _FACTOR_SECONDS * len(report.measurements) * combinations * slow * many
        return fix + self._preparing_seconds(new)

    def seconds_of_paths(self, spans: Mapping[str, float], count: int) -> float:
        """Estimate how long a fix of so many measurements takes of which some are of paths, s.

        Parameters
        ----------
        spans : mapping of str to float, dB
            How weak the paths of each station may be.
        count : int
        """
        new = [name for name, span in spans.items() if not self._reweighted.has_detected(name, span)]
        return _SETS_SECONDS + _PATH_SECONDS * count + self._preparing_seconds(new)

    def _preparing_seconds(self, names: Sequence[str]) -> float:
        """Estimate how long it takes to work out the weights of stations under a rule that is not kept, s."""
        maps = [self._table.parts[name].paths for name in names if name in self._table.parts]
        return sum(_PREPARING_SECONDS * len(paths) for paths in maps if paths is not None)

    def posterior(
        self,
        observations: Sequence[Observation],
        prior: Prior,
        stop: Stop = NEVER,
        selections: Mapping[str, Selection] = NO_SELECTIONS,
        paths: SortedPaths | None = None,
    ) -> GridPosterior:
        """Integrate the posterior of observations.

        Parameters
        ----------
        selections : mapping of str to Selection
            Rules of stations whose rule is not the table's.
        paths : SortedPaths, optional
            Measured paths of stations that report several.

        Raises
        ------
        FixStoppedError
            When it was stopped.
        """
        longest, origin = self._table.site.max_path_length, self._table.scene.origin
        at = {name: np.subtract(part.station.position, origin) for name, part in self._table.parts.items()}
        factors = [path_factor(each, self._settings, longest, at[each.station_id]) for each in observations]
        stations = []
        for each in observations:
            stop.check()
            stations.append(self._station(each.station_id, selections.get(each.station_id)))
        sets = NO_SETS if paths is None else self._sets(paths, stop)
        leaves, omitted = integrate(
            self.tree, stations, factors, prior, _SETS_LIMITS if sets else self._limits, stop, sets
        )
        log_all_outlier = sum(float(np.log(factor.outlier)) for factor in factors) + sets.log_all_spurious
        return GridPosterior(leaves=leaves, log_all_outlier=log_all_outlier, omitted=omitted)

    def _sets(self, paths: SortedPaths, stop: Stop) -> PathSets:
        groups = []
        for group in paths.groups:
            sets = []
            for name, within_db, measured in group:
                stop.check()
                stored = self._table.parts[name].paths
                assert stored is not None
                sets.append(StationSet(self._reweighted.detected(name, stored, self.tree, within_db), measured))
            groups.append(tuple(sets))
        return PathSets(groups=tuple(groups))

    @property
    def tree(self) -> BlockTree:
        """Blocks of the table's free space."""
        if self._tree is None:
            space = self._table.scene.free_space_in_table_frame
            paths = next(part.paths for part in self._table.parts.values() if part.paths is not None)
            self._tree = BlockTree(space, max(1, round(paths.voxel_size / space.voxel_size)))
        return self._tree

    def _station(self, name: str, selection: Selection | None = None) -> StationPaths:
        if selection is not None:
            paths = self._table.parts[name].paths
            assert paths is not None
            return self._reweighted.selected(name, paths, self.tree, selection)
        found = self._stations.get(name)
        if found is None:
            paths = self._table.parts[name].paths
            assert paths is not None
            found = self._stations[name] = StationPaths(paths, self.tree)
        return found


def _num_terms(length: Range | LogRange) -> int:
    """Count the Gaussians that the error of a length may be of."""
    if isinstance(length, LogRange):
        return len(log_normal_terms(length.path_length, length.log_stdev))
    return len(spreads(length.error_model))


def _narrowest(observation: Observation) -> float:
    """Smallest standard deviation of an observation's angles, rad, infinite where there is none."""
    cov = observation.direction.cov if observation.direction.local is None else observation.direction.local.cov
    if not np.isfinite(cov[0, 0]):
        return np.inf
    if not np.isfinite(cov[1, 1]):
        return float(np.sqrt(cov[0, 0]))
    return float(np.sqrt(np.linalg.eigvalsh(cov)[0]))
