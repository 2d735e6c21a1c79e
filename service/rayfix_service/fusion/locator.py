"""The face of the fusion: a table and a report in, a fix out."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.beam import Hypotheses, multiply
from rayfix_service.fusion.credible import CredibleRegions, posterior_points
from rayfix_service.fusion.factor_kernels import ALL_OUTLIER
from rayfix_service.fusion.factors import Factor, make_factor
from rayfix_service.fusion.heard import HeardStation
from rayfix_service.fusion.modes import cut_to_free_space, find_modes, unit_points
from rayfix_service.fusion.normal import normal_points
from rayfix_service.fusion.observations import Observation, SortedReport, sort_report
from rayfix_service.fusion.outliers import outlier_probabilities
from rayfix_service.fusion.posterior import Posterior, make_posterior
from rayfix_service.fusion.prior import Prior, even_prior, height_prior
from rayfix_service.fusion.report import Angle, Candidate, Fix, Outcome, Range, Report, Status
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.table import Table

_LEAST_CANDIDATE = 1e-3
"""Candidates less probable than this are not told."""

_REGION_POINTS = 1024
"""Points that stand for the posterior in credible regions."""

_NO_RAYS = "no ray of station '{}' comes from that direction"


class Locator:
    """Answers reports from a table.

    Parameters
    ----------
    table : Table
    settings : FusionSettings, optional
    """

    def __init__(self, table: Table, settings: FusionSettings | None = None) -> None:
        self.table = table
        self.settings = settings or FusionSettings()
        self._even_prior = even_prior(table.scene.free_space)
        self._stations = {name: HeardStation(part) for name, part in table.parts.items()}
        self._points = unit_points()
        self._region_points = normal_points(_REGION_POINTS)

    def locate(self, report: Report) -> Fix:
        """Fuse the measurements of a report.

        Raises
        ------
        ReportError
            When the report cannot be used; its ``path`` names the field.
        """
        return self._locate(report, self._product(report))

    def fuse(self, report: Report) -> "Fused":
        """Locate a report and keep what its fix was made of, for filters that go on with it.

        Raises
        ------
        ReportError
            When the report cannot be used; its ``path`` names the field.
        """
        product = self._product(report)
        return Fused(fix=self._locate(report, product), hypotheses=product.hypotheses, prior=product.prior)

    def _locate(self, report: Report, product: "_Product") -> Fix:
        observations, unused, _, hypotheses = product
        if hypotheses is None:
            return self._fix(report, "insufficient", (), {}, unused, 0.0, None)
        if not len(hypotheses):
            outlier = outlier_probabilities(observations, hypotheses.outlier, np.empty(0), 1.0)
            return self._fix(report, "inconsistent", (), outlier, unused, hypotheses.log_lost, None)
        log_weight, mean, cov = cut_to_free_space(
            hypotheses.log_weight, hypotheses.mean, hypotheses.cov, self.table.scene.free_space, self._points
        )
        log_sum = _log_sum(log_weight)
        log_evidence = float(np.logaddexp(log_sum, hypotheses.log_lost))
        lost = float(np.exp(hypotheses.log_lost - log_evidence))
        log_weight = log_weight - log_sum
        weight = np.exp(log_weight) * (1.0 - lost)
        keep = log_weight > np.log(self.settings.hypothesis_floor)
        modes = find_modes(log_weight[keep], mean[keep], cov[keep], self.table.scene.free_space)
        candidates = tuple(
            Candidate(probability=float(p) * (1.0 - lost), position=x, covariance=c)
            for n, (p, x, c) in enumerate(zip(modes.probability, modes.position, modes.cov, strict=True))
            if p > _LEAST_CANDIDATE or n == 0
        )
        half_bad = (hypotheses.outlier == ALL_OUTLIER).mean(axis=1) >= 0.5
        status = self._status(candidates, lost + float(weight[half_bad].sum()))
        outlier = outlier_probabilities(observations, hypotheses.outlier, weight, lost)
        regions = CredibleRegions(
            position=candidates[0].position,
            covariance=candidates[0].covariance,
            points=posterior_points(
                hypotheses.log_weight, hypotheses.mean, hypotheses.cov, self.table.scene.free_space, self._region_points
            ),
            share=1.0 - lost,
        )
        return self._fix(report, status, candidates, outlier, unused, log_evidence, regions)

    def posterior(self, report: Report) -> Posterior:
        """Fuse the measurements of a report into the density of the UE's position, for pictures and samples.

        Raises
        ------
        ReportError
            When the report cannot be used; its ``path`` names the field.
        """
        product = self._product(report)
        return make_posterior(product.hypotheses, product.prior, self.table.scene.free_space)

    def warm_up(self) -> None:
        """Compile the kernels and prepare reports without angles, by locating a report of each kind."""
        window = self.table.parts[self.table.site.stations[0].id].levels[0].window
        for station in self.table.site.stations:
            length = Range(station_id=station.id, path_length=5.0, stdev=0.5)
            self.locate(Report(measurements=(length,)))
            for stdev in (0.5 * window, window):  # looked up in one cell and in several
                angle = Angle(station_id=station.id, azimuth=0.5, zenith=1.8, azimuth_stdev=stdev, zenith_stdev=stdev)
                self.locate(Report(measurements=(angle, length)))

    def _product(self, report: Report) -> "_Product":
        """Multiply what the measurements say."""
        sorted_report = sort_report(report, self.table.site)
        free_space = self.table.scene.free_space
        prior = self._even_prior if report.height is None else height_prior(report.height, free_space)
        unused = dict(sorted_report.unused)
        observations, factors = self._factors(sorted_report, prior, unused)
        hypotheses = None
        if factors:
            hypotheses = multiply(
                factors,
                num_clocks=sorted_report.num_clocks,
                max_path_length=self.table.site.max_path_length,
                prior=prior,
                width=self.settings.beam_width,
                max_divergence=self.settings.max_divergence,
            )
        return _Product(observations, unused, prior, hypotheses)

    def _factors(
        self, sorted_report: SortedReport, prior: Prior, unused: dict[int, str]
    ) -> tuple[list[Observation], list[Factor]]:
        """Factors of the observations that can contribute; why others cannot goes to ``unused``."""
        observations, factors = [], []
        for observation in sorted_report.observations:
            factor = make_factor(
                observation,
                self._stations[observation.station_id],
                num_clocks=sorted_report.num_clocks,
                max_path_length=self.table.site.max_path_length,
                prior=prior,
                settings=self.settings,
            )
            if factor is not None:
                observations.append(observation)
                factors.append(factor)
                continue
            for index in (observation.angle_index, *observation.timing_indices):
                if index is not None:
                    unused[index] = _NO_RAYS.format(observation.station_id)
        return observations, factors

    def _status(self, candidates: tuple[Candidate, ...], half_bad: float) -> Status:
        """Status of a fix, given the probability that at least half of the factors are outliers."""
        if half_bad > 0.5:
            return "inconsistent"
        if candidates[0].probability < self.settings.ambiguous_below:
            rivals = sum(candidate.probability for candidate in candidates[: self.settings.most_rivals])
            return "ambiguous" if rivals >= self.settings.ambiguous_below else "insufficient"
        largest = float(np.sqrt(np.linalg.eigvalsh(candidates[0].covariance)[-1]))
        return "insufficient" if largest > self.settings.insufficient_above else "ok"

    def _fix(
        self,
        report: Report,
        status: Status,
        candidates: tuple[Candidate, ...],
        outlier: dict[int, float],
        unused: dict[int, str],
        log_evidence: float,
        regions: CredibleRegions | None,
    ) -> Fix:
        outcomes = tuple(
            Outcome(used=False, reason=unused[i])
            if i in unused
            else Outcome(used=True, outlier_probability=outlier.get(i))
            for i in range(len(report.measurements))
        )
        return Fix(
            status=status,
            candidates=candidates,
            outcomes=outcomes,
            log_evidence=log_evidence,
            regions=regions,
            confidence=report.confidence,
            table_id=self.table.table_id,
            target_id=report.target_id,
            timestamp=report.timestamp,
        )


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A fix, and the likelihood that it comes from.

    The probability density of the report at a place x is ``sum_h exp(log_weight_h) N(x; mean_h, cov_h) / prior(x)``,
    and ``exp(log_lost)`` besides for the case that all measurements are outliers.

    Attributes
    ----------
    fix : Fix
    hypotheses : Hypotheses or None
        Of the position, not yet cut to the free space; None where no measurement could be used.
    prior : Prior
        Of the position, with which the hypotheses' Gaussians are multiplied.
    """

    fix: Fix
    hypotheses: Hypotheses | None
    prior: Prior


class _Product(NamedTuple):
    """Hypotheses of a report, None where nothing could be used, and what they were made of."""

    observations: list[Observation]
    unused: dict[int, str]
    prior: Prior
    hypotheses: Hypotheses | None


def _log_sum(values: NDArray[np.float64]) -> float:
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))
