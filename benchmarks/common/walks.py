"""Simulated targets that walk through a building, and their position errors with and without tracking."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.drops.accuracy import Drop, clear_of_solids, drop_positions
from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report
from rayfix_service.locator import Locator
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire import parse_report
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.table import Table

GROSS_ERROR = 1.0
"""An error above this, m, is a gross failure."""

_MARGIN = 0.25
_LEG = (1.0, 8.0)
_START = datetime(2026, 1, 1, tzinfo=UTC)


def walk(
    table: Table,
    rng: np.random.Generator,
    *,
    count: int,
    interval: float,
    speed: float,
    heights: tuple[float, float] = (0.8, 1.6),
) -> NDArray[np.float64]:
    """Walk from one random place to another, straight on, with 0.25 m to all solids.

    Parameters
    ----------
    count : int
        Places along the way.
    interval : float, s
        Time between them.
    speed : float, m / s
    heights : tuple of float, m
        Between which the target's height is drawn; it keeps it.

    Returns
    -------
    ndarray of shape (count, 3), m
    """
    space, height = table.scene.free_space, float(rng.uniform(*heights))

    def place() -> NDArray[np.float64]:
        while True:
            found = np.append(drop_positions(table, 1, rng)[0, :2], height)
            if clear_of_solids(space, found[None], margin=_MARGIN)[0]:
                return found

    places = [place()[None]]
    while sum(len(leg) for leg in places) < count:
        begin, end = places[-1][-1], place()
        length = float(np.linalg.norm(end - begin))
        if _LEG[0] <= length <= _LEG[1] and _is_clear(space, begin, end):
            steps = max(1, round(length / (speed * interval)))
            places.append(begin + np.arange(1, steps + 1)[:, None] / steps * (end - begin))
    return np.concatenate(places)[:count]


def _is_clear(space: FreeSpace, begin: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    steps = int(np.linalg.norm(end - begin) / (0.5 * space.voxel_size)) + 2
    line = begin + np.linspace(0.0, 1.0, steps)[:, None] * (end - begin)
    return bool(clear_of_solids(space, line, margin=_MARGIN).all())


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Errors of estimates and what the estimates say of them.

    Attributes
    ----------
    distance : ndarray of shape (n,), m
    nees : ndarray of shape (n,)
        Normalised estimation error squared, ``e . covariance^-1 e``: of Gaussian errors that are as stated, a chi2
        variable with three degrees of freedom (Bar-Shalom et al., 2001, 5.4.2).
    """

    distance: NDArray[np.float64]
    nees: NDArray[np.float64]

    @property
    def rmse(self) -> float:
        """Root of the mean square of the distance, m."""
        return float(np.sqrt(np.mean(self.distance**2)))

    @property
    def gross_share(self) -> float:
        """Share of gross failures."""
        return float(np.mean(self.distance > GROSS_ERROR))


@dataclass(frozen=True, kw_only=True)
class Followed:
    """Errors of the same reports' fixes and tracks."""

    fixes: Errors
    tracks: Errors


def follow_walks(
    locator: Locator,
    tracker: Tracker,
    walks: Sequence[Sequence[Drop]],
    noise: Noise,
    *,
    interval: float,
    seed: int,
    timing: Timing = "none",
    stations: Collection[str] | None = None,
) -> Followed:
    """Report from each place of each walk, and compare fixes and tracks with the truth.

    Parameters
    ----------
    walks : sequence of sequence of Drop
        Places that some station hears; a report that gives no position is left out of both.
    interval : float, s
    seed : int
        Of the noise; each walk has its own.
    stations : collection of str, optional
        Stations that measure; all when left out.
    """
    found: list[tuple[float, float, float, float]] = []
    for number, drops in enumerate(walks):
        rng = np.random.default_rng([seed, number])
        for n, drop in enumerate(drops):
            paths = {name: p for name, p in drop.paths.items() if stations is None or name in stations}
            if not paths:
                continue
            moment = (_START + timedelta(seconds=n * interval)).isoformat()
            report = simulate_report(
                paths, noise, rng=rng, timing=timing, target_id=f"{seed}-{number}", timestamp=moment
            )
            fused = locator.fuse(parse_report(report))
            track = tracker.follow(fused)
            if fused.fix.position is None or fused.fix.covariance is None or track is None:
                continue
            fix = _error(fused.fix.position, fused.fix.covariance, drop.position)
            found.append((*fix, *_error(track.estimate.position, track.estimate.covariance, drop.position)))
    columns = np.array(found).reshape(-1, 4).T
    return Followed(
        fixes=Errors(distance=columns[0], nees=columns[1]), tracks=Errors(distance=columns[2], nees=columns[3])
    )


def _error(
    position: NDArray[np.float64], covariance: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[float, float]:
    apart = position - truth
    return float(np.linalg.norm(apart)), float(apart @ np.linalg.solve(covariance, apart))
