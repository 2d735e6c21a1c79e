"""The face of the fusion: a table and a report in, a fix out."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rayfix_service.fusion.diagnosis.suspects import suspects
from rayfix_service.fusion.diagnosis.turned import find_turns, turn_warning, turned_report
from rayfix_service.fusion.measurements.observations import Observation, SortedReport, sort_report
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.posterior.fixes import Product, make_fix
from rayfix_service.fusion.posterior.points import DrawnPoints
from rayfix_service.fusion.posterior.posterior import Posterior, make_posterior
from rayfix_service.fusion.product.beam import Hypotheses, multiply
from rayfix_service.fusion.product.cost import CostEstimate
from rayfix_service.fusion.product.factors import Factor, make_factor
from rayfix_service.fusion.product.prior import Prior, height_prior, uniform_prior
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

_NO_RAYS = "no ray of station '{}' comes from that direction"

_TOO_MUCH = "left out: the measurements before it need all the work that one report may take; send fewer at once"

_FEWER_ERRORS = (
    "of {} paths the less probable combinations of errors were left out, since there were too many; send fewer "
    "measurements of one path whose errors are heavy-tailed or log-normal"
)

_FEWER_HYPOTHESES = (
    "less probable hypotheses were left out, since there were too many products to form; send fewer measurements, or "
    "time differences that are connected"
)


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
        self._uniform_prior = uniform_prior(table.scene.free_space)
        self._stations = {name: StationMixtures(part) for name, part in table.parts.items()}
        largest = max((part.levels[-1].num_components for part in table.parts.values()), default=0)
        self._most_considered = max(self.settings.most_considered, self.settings.considered_tables * largest)
        self._cost = CostEstimate(self._stations, self.settings)

    def locate(self, report: Report, *, stop: Stop = NEVER) -> Fix:
        """Fuse the measurements of a report.

        Parameters
        ----------
        report : Report
        stop : Stop
            Ends it early, from another thread.

        Raises
        ------
        ReportError
            When the report cannot be used; its ``path`` names the field.
        FixStoppedError
            When it was stopped.
        """
        return self.explain(report, self.fuse(report, stop=stop).fix, stop=stop)

    def explain(self, report: Report, fix: Fix, *, stop: Stop = NEVER) -> Fix:
        """Search the stations of an inconsistent report for a constant turn of their angles, and warn of it.

        :meth:`locate` does it at once. The search takes at most ``FusionSettings.most_turn_fixes`` further fixes, and
        none for a fix of another status.

        Parameters
        ----------
        report : Report
        fix : Fix
            Of that report.
        stop : Stop
            As of :meth:`locate`.
        """
        if fix.status != "inconsistent" or self.settings.most_turn_fixes == 0:
            return fix

        def relocate(changed: Report, turns: Mapping[str, float]) -> Fix:
            changed, site = turned_report(changed, self.table.site, turns)
            return make_fix(changed, self._product(changed, site, stop), self.table, self.settings, stop)

        turns = find_turns(report, fix, self.table.site, relocate, most_fixes=self.settings.most_turn_fixes)
        return replace(fix, warnings=(*fix.warnings, turn_warning(turns))) if turns else fix

    def fuse(self, report: Report, *, stop: Stop = NEVER) -> "Fused":
        """Locate a report and keep what its fix was made of, for filters that go on with it; does not :meth:`explain`.

        Parameters
        ----------
        report : Report
        stop : Stop
            As of :meth:`locate`, and so are the errors.
        """
        product = self._product(report, self.table.site, stop)
        fix = make_fix(report, product, self.table, self.settings, stop)
        if fix.status == "inconsistent":
            fix = replace(fix, warnings=(suspects(report, fix),))
        return Fused(fix=fix, hypotheses=product.hypotheses, prior=product.prior)

    def posterior(self, report: Report, *, stop: Stop = NEVER) -> Posterior:
        """Fuse the measurements of a report into the density of the UE's position, for pictures and samples.

        Parameters
        ----------
        report : Report
        stop : Stop
            As of :meth:`locate`, and so are the errors.
        """
        product = self._product(report, self.table.site, stop)
        return make_posterior(product.hypotheses, product.prior, self.table.scene.free_space, stop)

    def seconds(self, report: Report) -> float:
        """Estimate how long a fix of a report will take, s, within some microseconds.

        It tells quick fixes from slow ones and is infinite for what is slow in any case.
        """
        return self._cost.seconds(report)

    def warm_up(self) -> None:
        """Compile the kernels and prepare reports without angles, by locating a report of each kind."""
        window = self.table.parts[self.table.site.stations[0].id].levels[0].window
        for station in self.table.site.stations:
            length = Range(station_id=station.id, path_length=5.0, stdev=0.5)
            self.locate(Report(measurements=(length,)))
            self.seconds(Report(measurements=(length,)))
            for stdev in (0.5 * window, window):  # looked up in one cell and in several
                angle = Angle(station_id=station.id, azimuth=0.5, zenith=1.8, azimuth_stdev=stdev, zenith_stdev=stdev)
                self.locate(Report(measurements=(angle, length)))
        points = DrawnPoints(mean=np.zeros((1, 3)), root=np.eye(3)[None], owner=np.zeros(8, np.int16))
        regions = CredibleRegions(position=np.zeros(3), covariance=np.eye(3), points=points, share=1.0)
        regions.upright_ellipsoid(0.5)
        _ = regions.accuracies(0.5).ellipsoid.semi_axes

    def _product(self, report: Report, site: SiteInfo, stop: Stop) -> Product:
        """Multiply what the measurements say, by the stations of a site."""
        sorted_report = sort_report(report, site)
        free_space = self.table.scene.free_space
        prior = self._uniform_prior if report.height is None else height_prior(report.height, free_space)
        unused = dict(sorted_report.unused)
        observations, factors = self._factors(sorted_report, prior, unused, stop)
        hypotheses = None
        if factors:
            hypotheses = multiply(
                factors,
                max_path_length=self.table.site.max_path_length,
                prior=prior,
                width=self.settings.beam_width,
                max_divergence=self.settings.max_divergence,
                most_products=self.settings.most_products,
                stop=stop,
            )
        simplified = []
        if bounded := sum([factor.omitted for factor in factors]):
            simplified.append(_FEWER_ERRORS.format(bounded))
        if hypotheses is not None and hypotheses.omitted:
            simplified.append(_FEWER_HYPOTHESES)
        return Product(observations, unused, prior, hypotheses, tuple(simplified))

    def _factors(
        self, sorted_report: SortedReport, prior: Prior, unused: dict[int, str], stop: Stop
    ) -> tuple[list[Observation], list[Factor]]:
        """Factors of the observations that can contribute; why others cannot goes to ``unused``."""
        observations, factors = [], []
        lost: dict[int, str] = {}
        left, count = self._most_considered, len(sorted_report.observations)
        for place, observation in enumerate(sorted_report.observations):
            factor = None
            if left > 0:
                factor = make_factor(
                    observation,
                    self._stations[observation.station_id],
                    num_clocks=sorted_report.num_clocks,
                    max_path_length=self.table.site.max_path_length,
                    prior=prior,
                    settings=self.settings,
                    most_considered=left // (count - place),
                    stop=stop,
                )
            if factor is not None:
                left -= factor.considered
                observations.append(observation)
                factors.append(factor)
                continue
            reason = _NO_RAYS.format(observation.station_id) if left > 0 else _TOO_MUCH
            for index in (observation.angle_index, *observation.timing_indices):
                if index is not None:
                    unused[index] = reason
            lost |= dict.fromkeys(observation.differences, reason)
        # A time difference is of two paths, and says something as long as one of them does.
        if lost:
            unused |= {n: lost[n] for n in lost.keys() - {n for o in observations for n in o.differences}}
        return observations, factors


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A fix, and the likelihood that it comes from.

    The probability density of the report at a place x is ``sum_h exp(log_weight_h) N(x; mean_h, cov_h) / prior(x)``,
    and ``exp(log_all_outlier)`` besides for the case that all measurements are outliers.

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
