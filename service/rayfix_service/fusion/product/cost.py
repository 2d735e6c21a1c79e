"""Estimate, from a report alone and in some microseconds, how long its fix will take.

The time follows from how many components of the table the measurements look up, how many combinations of errors each of
these is taken with, and how many products there are to form. The counts below are upper bounds, from figures of each
station that are computed once; the constants are fitted to measured times
(``benchmarks/fusion/worst_reports.py``), on an idle core. The caller only needs to know whether a report is quick, so
that wide bounds suffice: the estimate is several times too high for most reports, and hardly ever too low.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rayfix_service.fusion.lookup.lookup import SUM_RATIO
from rayfix_service.fusion.measurements.likelihood import log_normal_terms, spreads
from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    Angle,
    LogRange,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.fusion.product.beam_kernels import product_costs
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.level import WINDOW_RATIO, Level

_FIX = 60e-6
"""What any fix takes, s."""

_PATH = 40e-6
"""What each path takes beside its components, s."""

_CELL = 3e-7
"""What finding a cell of a sum takes, s."""

_LOOKED_UP = 2e-7
"""What conditioning a component takes, s."""

_CONSIDERED = 4e-7
"""What weighing and merging an alternative takes, s."""

_PRODUCT = 1.7e-8
"""What forming a product takes where there is no clock, s."""

_MEASUREMENT = 2e-5
"""What sorting a measurement takes, s."""

_EVERYWHERE = 2e-6
"""What a component takes when those of all directions are merged for the first time, s."""

_PER_PART = 512
"""Alternatives of a part that merging seldom leaves more of."""

_HYPOTHESES = 256
"""Hypotheses that merging seldom leaves more of."""

_HYPOTHESIS = 3e-6
"""What summing a hypothesis up takes, s."""

_UNMODELLED = 5
"""Alternatives that the path is none of the table's, for each combination of the errors of its length."""

_FEW, _FEW_COMPONENTS, _FEW_SECONDS = 4, 128, 2e-3
"""So many measurements of narrow angles, in cells of no more components, take less than so long, s."""

_MANY = 32
"""A report of more measurements than this is not quick, without a closer estimate."""


@dataclass(frozen=True, kw_only=True)
class _LevelCost:
    """Figures of a level: the widest noise one cell and a sum of a few take, rad; components a cell and in all."""

    level: Level
    one_cell: float
    few_cells: float
    most: int
    mean: float
    total: int
    rings: int


def _level_cost(level: Level) -> _LevelCost:
    counts = np.diff(level.cell_offsets)
    one = level.window / WINDOW_RATIO * (1.0 + 1e-9)
    return _LevelCost(
        level=level,
        one_cell=one,
        few_cells=SUM_RATIO * one,
        most=int(counts.max(initial=0)),
        mean=float(counts.mean()) if len(counts) else 0.0,
        total=level.num_components,
        rings=level.grid.num_rings,
    )


@dataclass
class _Paths:
    """Measurements of one station: angles, and the combinations of errors of each length and of all readings."""

    angles: list[Angle] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    readings: int = 0
    combinations: int = 1
    judged: bool = False


class CostEstimate:
    """Estimates how long fixes will take.

    Parameters
    ----------
    stations : mapping of str to StationMixtures
    settings : FusionSettings
    """

    def __init__(self, stations: Mapping[str, StationMixtures], settings: FusionSettings) -> None:
        self._stations = stations
        self._levels = {name: [_level_cost(level) for level in s.part.levels] for name, s in stations.items()}
        self._settings = settings
        # Up to which deviation an angle is looked up in one cell of few components.
        self._narrow = {name: v[0].one_cell for name, v in self._levels.items() if v[0].most <= _FEW_COMPONENTS}

    def seconds(self, report: Report) -> float:
        """Estimate how long a fix will take, s; infinite for a report of very many measurements."""
        measurements = report.measurements
        if len(measurements) > _MANY:
            return math.inf
        if len(measurements) <= _FEW and self._narrow_angles(measurements):
            return _FEW_SECONDS
        paths: defaultdict[str, _Paths] = defaultdict(_Paths)
        edges: list[tuple[str, str]] = []
        clocks = 0
        for m in measurements:
            of = paths[m.station_id]
            match m:
                case Angle():
                    of.angles.append(m)
                case Range():
                    of.lengths.append(len(spreads(m.error_model)))
                case LogRange():
                    of.lengths.append(len(log_normal_terms(m.path_length, m.log_stdev)))
                case TimeOfArrival():
                    of.readings += 1
                    of.combinations *= len(spreads(m.error_model))
                    clocks = 1
                case TimeDifference():
                    edges.append((m.station_id, m.reference_station_id))
                    for name in edges[-1]:
                        paths[name].readings += 1
                        paths[name].combinations *= len(spreads(m.error_model))
            if isinstance(m, Angle | Range | TimeOfArrival) and m.los_probability is not None:
                of.judged = True
        if edges:
            clocks += _num_parts(edges)
        seconds = _FIX + _MEASUREMENT * len(measurements)
        alternatives: list[int] = []
        for name, of in paths.items():
            if name in self._stations:  # else the report will be refused
                seconds += self._paths(name, of, alternatives)
        return seconds + self._products(alternatives, 3 + clocks)

    def _narrow_angles(self, measurements: Iterable[Measurement]) -> bool:
        """Whether there are only angles that one cell answers, and ranges beside them, as in most reports."""
        angles, ranges = set[str](), set[str]()
        for m in measurements:
            if isinstance(m, Angle):
                widest = self._narrow.get(m.station_id, 0.0)
                if m.zenith_stdev is None or m.zenith_stdev > widest or m.azimuth_stdev > widest:
                    return False
                angles.add(m.station_id)
            elif isinstance(m, Range):
                ranges.add(m.station_id)
            else:
                return False
            if m.error_model is not GAUSSIAN:
                return False
        return ranges <= angles

    def _paths(self, name: str, of: _Paths, alternatives: list[int]) -> float:
        """Seconds of the paths to a station; how many alternatives each will have is added to a list."""
        seconds = 0.0
        count = max(len(of.angles), 1)
        for k in range(count):
            combinations = of.combinations if k == 0 else 1
            for terms in of.lengths[k : k + 1] + (of.lengths[count:] if k == 0 else []):
                combinations *= terms
            cost, found, parts = self._looked_up(name, of.angles[k] if of.angles else None, of.judged)
            kinds = combinations + (1 if of.angles and (of.readings or of.lengths) else 0)
            considered = found * kinds
            seconds += _PATH + cost + _LOOKED_UP * found + _CONSIDERED * considered
            unmodelled = _UNMODELLED * combinations if of.angles and of.lengths and not of.readings else 0
            found_at_most = min(considered, _PER_PART * parts * kinds, self._settings.most_alternatives)
            alternatives.append(found_at_most + unmodelled + 1)
        return seconds

    def _looked_up(self, name: str, angle: Angle | None, judged: bool) -> tuple[float, int, int]:
        """Seconds of finding the components that answer an angle, at most how many there are, and Gaussians of errors.

        Where there is no angle, all directions answer; their components are merged once for all reports.
        """
        levels = self._levels[name]
        if angle is None:
            station = self._stations[name]
            kept = station.kept(judged)
            return (0.0, kept, 1) if kept is not None else (_EVERYWHERE * levels[-1].total, levels[-1].total, 1)
        seconds, found = 0.0, 0
        scales = [spread.scale for spread in spreads(angle.error_model)]
        for scale in scales:
            cells, components = _cells(levels, angle, scale)
            seconds += _CELL * cells
            found += components
        return seconds, found, len(scales)

    def _products(self, alternatives: Iterable[int], dimension: int) -> float:
        """Seconds of the products, few alternatives first, and of summing up what they come to."""
        width = self._settings.beam_width
        product_cost, merge_cost = product_costs(dimension)
        cost, hypotheses = 0.0, 1
        for count in sorted(alternatives):
            products = hypotheses * count
            cost += product_cost * products + merge_cost * min(products, width)
            hypotheses = min(products, _HYPOTHESES)
        return _PRODUCT * min(cost, self._settings.most_products) + _HYPOTHESIS * hypotheses


def _cells(levels: list[_LevelCost], angle: Angle, scale: float) -> tuple[float, int]:
    """At most how many cells answer an angle, and with how many components."""
    last = levels[-1]
    azimuth = scale * angle.azimuth_stdev
    if angle.zenith is None or angle.zenith_stdev is None:
        step = math.pi / last.rings
        cells = last.rings * min(2 * last.rings, 6.0 * azimuth / step + 3.0)
        return cells, min(last.total, int(2.0 * last.mean * cells))
    widest = max(azimuth, scale * angle.zenith_stdev)
    for level in levels:
        if widest <= level.one_cell:
            return 1.0, _in_cell(level, angle)
        if widest <= level.few_cells:
            # The whole noise is that of the weights at most, which reach to three deviations.
            step = math.pi / level.rings
            cells = (6.0 * widest / step + 2.0) ** 2
            return cells, min(level.total, int(2.0 * level.mean * cells))
    step = math.pi / last.rings
    cells = min((6.0 * widest / step + 2.0) ** 2, 2.0 * last.rings**2)
    return cells, min(last.total, int(2.0 * last.mean * cells))


def _in_cell(level: _LevelCost, angle: Angle) -> int:
    """At most how many components the cell of an angle has; its station's bias moves it little and is left aside."""
    if angle.frame != "scene" or angle.zenith is None:
        return level.most
    cell, _, _ = level.level.grid.cell_around(angle.azimuth, angle.zenith)
    offsets = level.level.cell_offsets
    return int(offsets[cell + 1] - offsets[cell])


def _num_parts(edges: list[tuple[str, str]]) -> int:
    """Into how many parts time differences fall that no station connects."""
    parent: dict[str, str] = {}

    def root(name: str) -> str:
        while (up := parent.setdefault(name, name)) != name:
            name = up
        return name

    for first, second in edges:
        parent[root(first)] = root(second)
    return sum(name == up for name, up in parent.items())
