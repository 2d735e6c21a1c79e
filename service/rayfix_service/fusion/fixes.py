"""Sum the hypotheses of a report up in a fix."""

import math
from typing import NamedTuple

import numpy as np

from rayfix_service.fusion.beam import Hypotheses
from rayfix_service.fusion.credible import CredibleRegions, posterior_points
from rayfix_service.fusion.kernels import log_sum
from rayfix_service.fusion.modes import cut_to_free_space, find_modes
from rayfix_service.fusion.observations import Observation
from rayfix_service.fusion.outliers import outlier_probabilities
from rayfix_service.fusion.prior import Prior
from rayfix_service.fusion.report import Candidate, Fix, Outcome, Report, Status
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.normal import normal_points, unit_points
from rayfix_tables.table import Table

_LEAST_CANDIDATE = 1e-3
"""Candidates less probable than this are not told."""

_REGION_POINTS = 1024
"""Points that stand for the posterior in credible regions."""


class Product(NamedTuple):
    """Hypotheses of a report, None where nothing could be used, and what they were made of.

    Attributes
    ----------
    observations : list of Observation
        Those that contribute.
    unused : dict of int to str
        Why measurements do not, by their places in the report.
    prior : Prior
    hypotheses : Hypotheses or None
    """

    observations: list[Observation]
    unused: dict[int, str]
    prior: Prior
    hypotheses: Hypotheses | None


def make_fix(report: Report, product: Product, table: Table, settings: FusionSettings) -> Fix:
    """Sum the hypotheses of a report up.

    Parameters
    ----------
    report : Report
    product : Product
        Of the report.
    table : Table
        Of the same site; its free space is what the hypotheses are cut to.
    settings : FusionSettings
    """
    candidates: tuple[Candidate, ...] = ()
    regions = None
    log_evidence, outlier = 0.0, dict[int, float]()
    status: Status = "insufficient"
    hypotheses = product.hypotheses
    if hypotheses is not None and not len(hypotheses):
        log_evidence, status = hypotheses.log_lost, "inconsistent"
        outlier, _ = outlier_probabilities(product.observations, hypotheses.outlier, np.empty(0), 1.0)
    elif hypotheses is not None:
        free_space = table.scene.free_space
        gaussians = hypotheses.log_weight, hypotheses.mean, hypotheses.cov
        log_weight, mean, cov = cut_to_free_space(*gaussians, free_space, unit_points())
        log_found = log_sum(log_weight)
        log_evidence = float(np.logaddexp(log_found, hypotheses.log_lost))
        lost = math.exp(hypotheses.log_lost - log_evidence)
        log_weight -= log_found
        keep = log_weight > math.log(settings.hypothesis_floor)
        modes = find_modes(log_weight[keep], mean[keep], cov[keep], free_space)
        candidates = tuple(
            Candidate(probability=p * (1.0 - lost), position=x, covariance=c)
            for n, (p, x, c) in enumerate(zip(modes.probability.tolist(), modes.position, modes.cov, strict=True))
            if p > _LEAST_CANDIDATE or n == 0
        )
        weight = (1.0 - lost) * np.exp(log_weight)
        outlier, half_bad = outlier_probabilities(product.observations, hypotheses.outlier, weight, lost)
        status = _status(candidates, half_bad, settings)
        regions = CredibleRegions(
            position=candidates[0].position,
            covariance=candidates[0].covariance,
            points=posterior_points(*gaussians, free_space, normal_points(_REGION_POINTS)),
            share=1.0 - lost,
        )
    outcomes = tuple(
        Outcome(used=False, reason=product.unused[n])
        if n in product.unused
        else Outcome(used=True, outlier_probability=outlier.get(n))
        for n in range(len(report.measurements))
    )
    return Fix(
        status=status,
        candidates=candidates,
        outcomes=outcomes,
        log_evidence=log_evidence,
        regions=regions,
        confidence=report.confidence,
        table_id=table.table_id,
        target_id=report.target_id,
        timestamp=report.timestamp,
    )


def _status(candidates: tuple[Candidate, ...], half_bad: float, settings: FusionSettings) -> Status:
    """Status of a fix, given the probability that at least half of the factors are outliers."""
    if half_bad > 0.5:
        return "inconsistent"
    if candidates[0].probability < settings.ambiguous_below:
        rivals = sum(candidate.probability for candidate in candidates[: settings.most_rivals])
        return "ambiguous" if rivals >= settings.ambiguous_below else "insufficient"
    # The sum of all variances is at least the largest, and three times it at most.
    most, cov = settings.insufficient_above**2, candidates[0].covariance
    narrow = float(cov.trace()) <= most or float(np.linalg.eigvalsh(cov)[-1]) <= most
    return "ok" if narrow else "insufficient"
