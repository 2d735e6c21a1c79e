"""Summarise the hypotheses of a report in a fix."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fix import Candidate, Fix, Outcome, Status
from rayfix_service.fusion.posterior.points import ListedPoints
from rayfix_service.fusion.posterior.summary import ReportPosterior
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.outliers import outlier_index
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.table import Table

_LEAST_CANDIDATE = 1e-3
"""Candidates less probable than this are left out of the fix."""


class Product(NamedTuple):
    """Posterior of a report, None where nothing could be used, and what it was made of.

    Attributes
    ----------
    observations : list of Observation
        Those that contribute.
    unused : dict of int to str
        Why measurements do not, by their indices in the report.
    prior : Prior
    posterior : ReportPosterior or None
    simplified : tuple of str
        What was worked out more coarsely than the report says, since the work per report is bounded or because
        rounding made covariances singular.
    """

    observations: list[Observation]
    unused: dict[int, str]
    prior: Prior
    posterior: ReportPosterior | None
    simplified: tuple[str, ...] = ()

    @property
    def hypotheses(self) -> Hypotheses | None:
        """The posterior as Gaussians."""
        return None if self.posterior is None else self.posterior.hypotheses()


def make_fix(report: Report, product: Product, table: Table, settings: FusionSettings, stop: Stop = NEVER) -> Fix:
    """Summarise the posterior of a report.

    Parameters
    ----------
    report : Report
    product : Product
        Of the report.
    table : Table
        Of the same site; its free space is what the posterior is cut to. The posterior is in its frame, the fix in the
        scene's.
    settings : FusionSettings
    stop : Stop
        Ends it early.

    Raises
    ------
    FixStoppedError
        When it was.
    """
    candidates: tuple[Candidate, ...] = ()
    regions = None
    log_evidence, outlier = 0.0, dict[int, float]()
    status: Status = "insufficient"
    posterior = product.posterior
    if posterior is not None:
        found = outlier_index(product.observations)
        space = table.scene.free_space_in_table_frame
        summary = posterior.summary(found, space, settings.hypothesis_floor, stop)
        if summary is None or not len(summary.probability):
            log_evidence, status = posterior.log_all_outlier, "inconsistent"
            outlier = dict.fromkeys(found.places, 1.0)
        else:
            log_evidence, share = summary.log_evidence, 1.0 - summary.lost
            candidates = tuple(
                Candidate(
                    probability=p * share,
                    position=summary.position[n],
                    covariance=_within(summary.moment[n], summary.position[n], space),
                )
                for n, p in enumerate(summary.probability.tolist())
                if p > _LEAST_CANDIDATE or n == 0
            )
            outlier = dict(zip(found.places, summary.outlier.tolist(), strict=True))
            status = _status(candidates, summary.half_bad, table.scene.free_space.largest_stdev, settings)
            best = candidates[0]
            regions = CredibleRegions(
                position=best.position,
                covariance=best.covariance,
                points=ListedPoints(position=space.points_all_over)
                if _is_beyond(summary.moment[0], best.position, space)
                else summary.points,
                share=share,
                stretch=settings.inconsistent_stretch if status == "inconsistent" else 1.0,
            )
    unused = product.unused
    outcomes = tuple(
        [
            Outcome(used=False, reason=unused[n])
            if n in unused
            else Outcome(used=True, outlier_probability=outlier.get(n))
            for n in range(len(report.measurements))
        ]
    )
    return Fix(
        status=status,
        candidates=candidates,
        outcomes=outcomes,
        log_evidence=log_evidence,
        regions=regions,
        confidence=report.confidence,
        simplified=product.simplified,
        table_id=table.table_id,
        target_id=report.target_id,
        timestamp=report.timestamp,
    ).moved(table.scene.origin)


def _within(covariance: NDArray[np.float64], position: NDArray[np.float64], space: FreeSpace) -> NDArray[np.float64]:
    """Return a covariance; that of a position anywhere where it reaches beyond the building."""
    return np.diag(_farthest(position, space) ** 2) if _is_beyond(covariance, position, space) else covariance


def _is_beyond(covariance: NDArray[np.float64], position: NDArray[np.float64], space: FreeSpace) -> bool:
    """Whether a second moment about a position is larger than that of any density in the building."""
    size = math.hypot(*space.free.shape) * space.voxel_size
    if covariance.trace() <= (0.5 * size) ** 2:  # from anywhere, the farthest corner is as far at least
        return False
    return bool(covariance.trace() > (_farthest(position, space) ** 2).sum())


def _farthest(position: NDArray[np.float64], space: FreeSpace) -> NDArray[np.float64]:
    """Return the distances along x, y and z, m, to the farthest corner."""
    ends = np.stack([space.origin, space.origin + space.voxel_size * np.array(space.free.shape)])
    return np.asarray(np.abs(ends - position).max(axis=0))


def _status(candidates: tuple[Candidate, ...], half_bad: float, anywhere: float, settings: FusionSettings) -> Status:
    """Status of a fix.

    Parameters
    ----------
    half_bad : float
        Probability that at least half of the factors are outliers.
    anywhere : float, m
        Largest standard deviation of a position of which nothing is known.
    """
    if half_bad > 0.5:
        return "inconsistent"
    if candidates[0].probability < settings.ambiguous_below:
        rivals = sum(candidate.probability for candidate in candidates[: settings.most_rivals])
        return "ambiguous" if rivals >= settings.ambiguous_below else "insufficient"
    # The sum of all variances is at least the largest, and three times it at most.
    most = min(settings.insufficient_above, settings.insufficient_share * anywhere) ** 2
    cov = candidates[0].covariance
    narrow = float(cov.trace()) <= most or float(np.linalg.eigvalsh(cov)[-1]) <= most
    return "ok" if narrow else "insufficient"
