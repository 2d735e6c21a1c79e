"""The face of the fusion: a table and a report in, a fix out."""

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.beam import Hypotheses, multiply
from rayfix_service.fusion.factors import ALL_GOOD, ALL_OUTLIER, Factor, make_factor
from rayfix_service.fusion.modes import Modes, cut_to_free_space, find_modes, unit_points
from rayfix_service.fusion.observations import Observation, SortedReport, sort_report
from rayfix_service.fusion.report import Angle, Candidate, Fix, Outcome, Range, Report, Status
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.table import Table

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
        self._log_volume = float(np.log(max(table.scene.free_space.volume, 1.0)))
        self._points = unit_points()

    def locate(self, report: Report) -> Fix:
        """Fuse the measurements of a report.

        Raises
        ------
        ReportError
            When a station is not in the table.
        """
        sorted_report = sort_report(report, self.table.site)
        unused = dict(sorted_report.unused)
        observations, factors = self._factors(sorted_report, unused)
        if not factors:
            return self._fix(report, "insufficient", (), {}, unused, 0.0)
        hypotheses = multiply(
            factors,
            num_clocks=sorted_report.num_clocks,
            max_path_length=self.table.site.max_path_length,
            log_volume=self._log_volume,
            width=self.settings.beam_width,
        )
        log_weight, mean, cov = cut_to_free_space(
            hypotheses.log_weight, hypotheses.mean, hypotheses.cov, self.table.scene.free_space, self._points
        )
        log_evidence = float(np.logaddexp(_log_sum(log_weight), hypotheses.log_lost))
        lost = float(np.exp(hypotheses.log_lost - log_evidence))
        log_weight = log_weight - _log_sum(log_weight)
        keep = log_weight > max(np.log(self.settings.hypothesis_floor), float(log_weight.max()) - 30.0)
        modes = find_modes(log_weight[keep], mean[keep], cov[keep], self.table.scene.free_space)
        outlier = _outlier_probabilities(observations, hypotheses.outlier, np.exp(log_weight))
        candidates = tuple(
            Candidate(probability=float(p) * (1.0 - lost), position=x, covariance=c)
            for p, x, c in zip(modes.probability, modes.position, modes.cov, strict=True)
            if p > 1e-3
        )
        status = self._status(hypotheses, log_weight, keep, modes, lost)
        return self._fix(report, status, candidates, outlier, unused, log_evidence)

    def warm_up(self) -> None:
        """Compile the kernels by locating a report of each kind."""
        for station in self.table.site.stations:
            angle = Angle(station_id=station.id, azimuth=0.5, zenith=1.8, azimuth_stdev=0.02, zenith_stdev=0.02)
            self.locate(Report(measurements=(angle, Range(station_id=station.id, path_length=5.0, stdev=0.5))))

    def _factors(self, sorted_report: SortedReport, unused: dict[int, str]) -> tuple[list[Observation], list[Factor]]:
        """Factors of the observations that can contribute; why others cannot goes to ``unused``."""
        observations, factors = [], []
        for observation in sorted_report.observations:
            factor = make_factor(
                observation,
                self.table.parts[observation.station_id],
                num_clocks=sorted_report.num_clocks,
                max_path_length=self.table.site.max_path_length,
                log_volume=self._log_volume,
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

    def _status(
        self,
        hypotheses: Hypotheses,
        log_weight: NDArray[np.float64],
        keep: NDArray[np.bool_],
        modes: Modes,
        lost: float,
    ) -> Status:
        weight = np.exp(log_weight)
        bad_factors = (hypotheses.outlier == ALL_OUTLIER).mean(axis=1)
        if lost + (1.0 - lost) * float(weight[bad_factors >= 0.5].sum()) > 0.5:
            return "inconsistent"
        largest = float(np.sqrt(np.linalg.eigvalsh(modes.cov[0])[-1]))
        if modes.probability[0] < self.settings.ambiguous_below:
            return "ambiguous"
        return "insufficient" if largest > self.settings.insufficient_above else "ok"

    def _fix(
        self,
        report: Report,
        status: Status,
        candidates: tuple[Candidate, ...],
        outlier: dict[int, float],
        unused: dict[int, str],
        log_evidence: float,
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
            table_id=self.table.table_id,
            target_id=report.target_id,
            timestamp=report.timestamp,
        )


def _outlier_probabilities(
    observations: list[Observation], outlier: NDArray[np.int8], weight: NDArray[np.float64]
) -> dict[int, float]:
    """Posterior probability of each used measurement to be an outlier, by its place in the report."""
    found: dict[int, float] = {}
    for n, observation in enumerate(observations):
        if observation.angle_index is not None:
            found[observation.angle_index] = float(min(1.0, weight[outlier[:, n] == ALL_OUTLIER].sum()))
        for index in observation.timing_indices:
            found[index] = float(min(1.0, weight[outlier[:, n] != ALL_GOOD].sum()))
    return found


def _log_sum(values: NDArray[np.float64]) -> float:
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))
