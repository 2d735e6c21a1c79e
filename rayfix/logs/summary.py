"""The summary of a log: by station, and by status."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rayfix.logs.residuals import Residual

_LEAST = 30
"""Residuals that it takes to suspect a bias."""

_SURE = 4.0
"""Standard errors of the mean that a bias must exceed, and ..."""

_LARGE = 0.5
"""... assumed standard deviations."""

_FAR = 5.0
"""Assumed standard deviations beyond which a residual is of a reflected path, rather than of an error."""


@dataclass
class Moments:
    """Sums over the residuals of one quantity."""

    count: int = 0
    total: float = 0.0
    squares: float = 0.0
    stdevs: float = 0.0

    def add(self, value: float, stdev: float) -> None:
        """Add a residual, and the deviation that it is assumed to have."""
        self.count += 1
        self.total += value
        self.squares += value * value
        self.stdevs += stdev

    @property
    def mean(self) -> float:
        """Mean of the residuals."""
        return self.total / self.count

    @property
    def deviation(self) -> float:
        """Standard deviation of the residuals."""
        return math.sqrt(max(self.squares / self.count - self.mean**2, 0.0))

    @property
    def assumed(self) -> float:
        """Mean of the deviations that they are assumed to have."""
        return self.stdevs / self.count

    @property
    def biased(self) -> bool:
        """Whether the mean is too large for chance."""
        error = max(self.deviation, 1e-9) / math.sqrt(self.count)
        return self.count >= _LEAST and abs(self.mean) > max(_SURE * error, _LARGE * self.assumed)


@dataclass
class StationFigures:
    """What a log says of one station."""

    reports: int = 0
    measurements: int = 0
    used: int = 0
    outliers: int = 0
    residuals: dict[str, Moments] = field(default_factory=dict)


@dataclass
class Summary:
    """What has been found in a log so far.

    Attributes
    ----------
    statuses : Counter
        Fixes by status.
    problems : int
        Entries without a fix.
    stations : dict
        Figures by station, those of the table first, in its order.
    """

    statuses: Counter[str] = field(default_factory=Counter)
    problems: int = 0
    stations: dict[str, StationFigures] = field(default_factory=dict)

    @property
    def fixes(self) -> int:
        """Number of fixes."""
        return sum(self.statuses.values())

    def add(self, status: str, residuals: Iterable[Residual]) -> None:
        """Add a fix."""
        self.statuses[status] += 1
        heard = set()
        for residual in residuals:
            figures = self.stations.setdefault(residual.station_id, StationFigures())
            figures.reports += residual.station_id not in heard
            heard.add(residual.station_id)
            figures.measurements += 1
            figures.used += residual.used
            figures.outliers += residual.outlier
            for quantity, value, stdev in residual.differences:
                if abs(value) <= _FAR * stdev:
                    figures.residuals.setdefault(quantity, Moments()).add(value, stdev)

    def document(self) -> dict[str, Any]:
        """Write the summary as JSON-compatible data."""
        return {
            "fixes": self.fixes,
            "problems": self.problems,
            "statuses": dict(sorted(self.statuses.items())),
            "stations": {
                name: {
                    "reports": figures.reports,
                    "measurements": figures.measurements,
                    "used": figures.used,
                    "outliers": figures.outliers,
                    "residuals": {
                        quantity: {
                            "count": moments.count,
                            "mean": moments.mean,
                            "deviation": moments.deviation,
                            "assumed": moments.assumed,
                            "suspected_bias": moments.mean if moments.biased else None,
                        }
                        for quantity, moments in sorted(figures.residuals.items())
                    },
                }
                for name, figures in self.stations.items()
            },
        }

    def state(self) -> dict[str, Any]:
        """Write all that is needed to go on, as JSON-compatible data."""
        return {
            "statuses": dict(self.statuses),
            "problems": self.problems,
            "stations": {
                name: vars(figures) | {"residuals": {q: vars(m) for q, m in figures.residuals.items()}}
                for name, figures in self.stations.items()
            },
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "Summary":
        """Read what :meth:`state` wrote."""
        stations = {
            name: StationFigures(
                **(figures | {"residuals": {q: Moments(**m) for q, m in figures["residuals"].items()}})
            )
            for name, figures in state["stations"].items()
        }
        return cls(statuses=Counter(state["statuses"]), problems=state["problems"], stations=stations)
