"""The tracks of all targets, and reports whose times are out of order."""

import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from time import monotonic

import numpy as np

from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fused import Fused
from rayfix_service.fusion.posterior.points import ListedPoints
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import uniform_prior
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_service.tracking.correlated import KnownHeight, update_drifting, with_drifts
from rayfix_service.tracking.drift import no_drifts, variance_factor
from rayfix_service.tracking.estimate import estimate
from rayfix_service.tracking.likelihood import likelihood_of
from rayfix_service.tracking.motion import MotionModel, step_of
from rayfix_service.tracking.on_paths import Measured, Stations
from rayfix_service.tracking.particles import Particles, Updated, birth, mixed, predict, update
from rayfix_service.tracking.settings import TrackingSettings
from rayfix_service.tracking.track import TrackedPosition, TrackState
from rayfix_service.tracking.walls import walls_of
from rayfix_tables.errors import ReportError
from rayfix_tables.scene import Scene
from rayfix_tables.table import Table

_MOST_HYPOTHESES = 512
"""Of a report, the best are taken in: each meets all particles, and few reports have a quarter as many."""

_LAST = 1.0
"""Seconds before a report that errors that drift are followed over at once, rather than step by step.

Known drifts make a report tell the way since the one before within centimetres, which a step without it would have to
hit by chance: with reports a second apart, 74 % of the targets were in the 90 % circle, and are 89 % so.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Track:
    """What is kept of a target.

    Attributes
    ----------
    seconds : float
        Time of ``position``, since 1970.
    touched : float, s
        Time of the target's last report, by the service's clock.
    strange : float or None
        Time of the last report, if it was long before the track.
    """

    particles: Particles
    position: TrackedPosition
    seconds: float
    touched: float
    rng: np.random.Generator
    strange: float | None = None


class Tracker:
    """Follows targets from report to report through one building; it may be used from several threads.

    docs/tracking.md describes the filter.

    Particles are in the table's frame, as hypotheses are; the positions that it gives are in the scene's.

    Parameters
    ----------
    table : Table or Scene
        Its scene's surfaces block the motion of targets.
    settings : TrackingSettings, optional
    clock : callable, optional
        The service's clock, s, by which targets are forgotten; reports have their own times.

    Attributes
    ----------
    dropped : int
        Hypotheses that updates have left out since their products with a track were singular.
    """

    def __init__(
        self, table: Table | Scene, settings: TrackingSettings | None = None, *, clock: Callable[[], float] = monotonic
    ) -> None:
        self.settings = settings or TrackingSettings()
        scene = table.scene if isinstance(table, Table) else table
        self._walls = walls_of(scene.in_table_frame)
        self._origin = scene.origin
        self.dropped = 0
        self._log_volume = uniform_prior(self._walls.free_space).log_volume
        self._stations = None
        if isinstance(table, Table) and self.settings.drift is not None:
            self._stations = Stations(table, self.settings.drift)
        self._clock = clock
        self._tracks: OrderedDict[str, _Track] = OrderedDict()  # the one with the latest report comes last
        self._lock = Lock()

    @property
    def num_targets(self) -> int:
        """Number of targets that are followed."""
        return len(self._tracks)

    def warm_up(self) -> None:
        """Compile the kernels, by a track of some particles that nobody sees."""
        settings, free_space, rng = self.settings, self._walls.free_space, np.random.default_rng(0)
        self._walls.passable(np.zeros((1, 3)), np.zeros((1, 3)))
        free = np.argwhere(free_space.free)
        if not len(free):
            return
        hypotheses = Hypotheses(
            log_weight=np.zeros(1),
            mean=free_space.origin + free_space.voxel_size * (free[:1] + 0.5),
            cov=(0.1 * free_space.voxel_size) ** 2 * np.eye(3)[None],
            outlier=np.zeros((1, 1), np.int8),
            log_all_outlier=-50.0,
        )
        particles = birth(hypotheses, free_space, settings.motion, 64, rng)
        assert particles is not None
        likelihood = likelihood_of(hypotheses, self._log_volume)
        updated = update(particles, likelihood, settings.motion, 0.1, self._walls, rng)
        if self._stations is not None and settings.drift is not None:
            for measured in self._stations.examples():
                particles = with_drifts(particles, measured, settings.drift, rng)
                update_drifting(particles, measured, settings.motion, settings.drift, 0.1, 1, self._walls, rng)
        position = _tracked("started", "1970-01-01T00:00:00Z", 1, particles if updated is None else updated.particles)
        position.regions.upright_ellipsoid(0.5)
        _ = position.regions.accuracies(0.5).ellipsoid.semi_axes

    def follow(self, fused: Fused) -> TrackedPosition | None:
        """Update a target's track with a report, and return its position.

        Returns
        -------
        TrackedPosition or None
            None as long as no report has constrained the position.

        Raises
        ------
        ReportError
            When the report names no target or no time.
        """
        name, timestamp = fused.fix.target_id, fused.fix.timestamp
        if name is None or timestamp is None:
            key = "target_id" if name is None else "timestamp"
            raise ReportError(f"{key} is missing; a target is followed by its target_id and timestamp", path=(key,))
        if fused.hypotheses is not None and fused.likelihood is not None:
            fused = replace(
                fused,
                hypotheses=fused.hypotheses.best(_MOST_HYPOTHESES),
                likelihood=fused.likelihood.best(_MOST_HYPOTHESES),
            )
        with self._lock:
            now = self._clock()
            self._forget(now)
            track = self._after(self._tracks.get(name), name, timestamp, fused, now)
            if track is None:
                self._tracks.pop(name, None)
                return None
            self._tracks[name] = track
            self._tracks.move_to_end(name)
            while len(self._tracks) > self.settings.max_targets:
                self._tracks.popitem(last=False)
            return track.position

    def _forget(self, now: float) -> None:
        """Forget targets without a report for long."""
        while self._tracks and now - next(iter(self._tracks.values())).touched > self.settings.max_age:
            self._tracks.popitem(last=False)

    def _after(self, track: _Track | None, name: str, timestamp: str, fused: Fused, now: float) -> _Track | None:
        """Return the track after a report, or None where there is none."""
        seconds = utc_moment(timestamp).timestamp()
        if track is None:
            digest = hashlib.sha256(name.encode()).digest()
            rng = np.random.default_rng([self.settings.seed, *np.frombuffer(digest, np.uint32).tolist()])
            return self._start("started", timestamp, seconds, fused, now, rng)
        gap = seconds - track.seconds
        if gap <= 0.0:
            # A report that is repeated, or was overtaken. Long before the track, it may be the first after the clock
            # was set back, which the second one confirms.
            long_before = gap < -self.settings.longest_gap
            if long_before and track.strange is not None and 0.0 < seconds - track.strange < self.settings.longest_gap:
                return self._start("restarted", timestamp, seconds, fused, now, track.rng)
            late = replace(track.position, state="late")
            return replace(track, position=late, touched=now, strange=seconds if long_before else track.strange)
        if gap > self.settings.longest_gap:
            return self._start("restarted", timestamp, seconds, fused, now, track.rng)
        return self._go_on(track, timestamp, gap, fused, now)

    def _start(
        self, state: TrackState, timestamp: str, seconds: float, fused: Fused, now: float, rng: np.random.Generator
    ) -> _Track | None:
        particles = self._newborn(fused, rng)
        if particles is None:
            return None
        position = _tracked(state, timestamp, 1, particles).moved(self._origin)
        return _Track(particles=particles, position=position, seconds=seconds, touched=now, rng=rng)

    def _newborn(self, fused: Fused, rng: np.random.Generator) -> Particles | None:
        """Particles from a report alone."""
        if not fused.hypotheses:
            return None
        settings = self.settings
        born = birth(fused.hypotheses, self._walls.free_space, settings.motion, settings.num_particles, rng)
        if born is None or self._stations is None or settings.drift is None:
            return born
        measured = self._stations.measured(fused.factors)
        if measured is None:
            return replace(born, drifts=no_drifts(len(born), rng))
        return with_drifts(born, measured, settings.drift, rng)

    def _go_on(self, track: _Track, timestamp: str, gap: float, fused: Fused, now: float) -> _Track | None:
        settings, rng = self.settings, track.rng
        num_steps = math.ceil(gap / settings.longest_step)
        step = gap / num_steps
        particles: Particles | None = track.particles
        if particles is not None and particles.drifts is not None and settings.drift is not None:
            particles = replace(particles, drifts=particles.drifts.aged(gap, settings.drift, rng))
        # The last step is the update, where the report constrains the position.
        num_last = 1 if fused.hypotheses else 0
        measured = self._stations.measured(fused.factors) if num_last and self._stations is not None else None
        if measured is not None:
            num_last = min(num_steps, max(1, math.floor(_LAST / step + 1e-9)))
        for _ in range(num_steps - num_last):
            if particles is not None:
                particles = predict(particles, settings.motion, step, self._walls, rng)
        state: TrackState = "predicted"
        if fused.hypotheses:
            update_with = partial(self._update, fused=fused, measured=measured, gap=gap, step=step, num_last=num_last)
            particles, state = self._take_in(particles, fused, update_with, rng)
        if particles is None:
            return None
        num_reports = 1 if state == "restarted" else track.position.num_reports + (state == "updated")
        position = _tracked(state, timestamp, num_reports, particles).moved(self._origin)
        return _Track(particles=particles, position=position, seconds=track.seconds + gap, touched=now, rng=rng)

    def _update(
        self,
        particles: Particles,
        rng: np.random.Generator,
        *,
        fused: Fused,
        measured: list[Measured] | None,
        gap: float,
        step: float,
        num_last: int,
    ) -> tuple[Updated | None, float]:
        """Update particles over the last steps; also gives the log evidence of the report if it began a new track."""
        assert fused.likelihood is not None
        settings = self.settings
        share = min(1.0, gap / settings.height_seconds)
        if measured is not None and settings.drift is not None:
            height = None
            if fused.prior.precision > 0.0:
                mean = fused.prior.eta / fused.prior.precision
                height = KnownHeight(mean, share * fused.prior.precision)
            found = update_drifting(
                particles,
                measured,
                settings.motion,
                settings.drift,
                num_last * step,
                num_last,
                self._walls,
                rng,
                height=height,
            )
            return found, fused.fix.log_evidence
        factor = 1.0
        if self._stations is not None and settings.drift is not None:
            heard = {each.station_id for each in fused.factors}
            factor = variance_factor(
                [self._stations.by_id[name] for name in sorted(heard)],
                settings.drift,
                gap,
                _variance_ratio(particles, fused.likelihood, settings.motion, step),
            )
        likelihood = likelihood_of(
            fused.likelihood, self._log_volume, height=fused.prior, height_share=share, variance_factor=factor
        )
        found = update(particles, likelihood, settings.motion, step, self._walls, rng)
        return found, fused.fix.log_evidence - 1.5 * math.log(factor)

    def _take_in(
        self,
        particles: Particles | None,
        fused: Fused,
        update_with: Callable[[Particles, np.random.Generator], tuple[Updated | None, float]],
        rng: np.random.Generator,
    ) -> tuple[Particles | None, TrackState]:
        """Update particles, those that could have moved at all, with a report, or begin anew with it."""
        updated, log_new = None, 0.0
        if particles is not None:
            updated, log_new = update_with(particles, rng)
        if updated is None:
            return self._newborn(fused, rng), "restarted"
        self.dropped += updated.dropped
        share = self._restart_share(log_new - updated.log_evidence)
        newborn = self._newborn(fused, rng) if 2.0 * share * self.settings.num_particles > 1.0 else None
        if newborn is None:
            return updated.particles, "updated"
        all_of_both = mixed(updated.particles, newborn, share, rng)
        return all_of_both, "restarted" if all_of_both is newborn else "updated"

    def _restart_share(self, log_ratio: float) -> float:
        """Posterior probability that the report begins a new track, given the log ratio of evidence for that."""
        odds = self.settings.restart_probability / (1.0 - self.settings.restart_probability)
        return 1.0 / (1.0 + math.exp(min(-log_ratio - math.log(odds), 700.0)))


def _variance_ratio(particles: Particles, hypotheses: Hypotheses, motion: MotionModel, seconds: float) -> float:
    """Horizontal variance of the particles' prediction, in that of a report."""
    step = step_of(motion, particles.velocity_variance, seconds)
    middle = particles.position + seconds * particles.velocity
    predicted = float((middle.var(axis=0) + step.variance)[:2].sum())
    weight = np.exp(hypotheses.log_weight - hypotheses.log_weight.max())
    weight /= weight.sum()
    mean = weight @ hypotheses.mean
    spread = weight @ ((hypotheses.mean - mean) ** 2 + np.einsum("hii->hi", hypotheses.cov))
    told = float(spread[:2].sum())
    # A broken covariance has no variance to compare with.
    return predicted / told if math.isfinite(told) and told > 0.0 else 1e6


def _tracked(state: TrackState, timestamp: str, num_reports: int, particles: Particles) -> TrackedPosition:
    found = estimate(particles)
    return TrackedPosition(
        state=state,
        timestamp=timestamp,
        num_reports=num_reports,
        estimate=found,
        regions=CredibleRegions(
            position=found.position,
            covariance=found.covariance,
            points=ListedPoints(position=particles.position),
            share=1.0,
        ),
    )
