"""Fuse the measurements of a report: the product of their likelihoods and of the prior."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rayfix_service.fusion.measurements.beside import PathsAndTimes, paths_and_times
from rayfix_service.fusion.measurements.calibrated import with_deviations
from rayfix_service.fusion.measurements.observations import Observation, SortedReport, sort_report
from rayfix_service.fusion.measurements.report import Angle, MeasuredPath, Range, Report
from rayfix_service.fusion.measurements.selection import check_gains, has_gains, selections_of
from rayfix_service.fusion.posterior.fixes import Product
from rayfix_service.fusion.posterior.fused import StationFactor
from rayfix_service.fusion.posterior.summary import GaussianPosterior
from rayfix_service.fusion.product.beam import multiply
from rayfix_service.fusion.product.cost import CostEstimate
from rayfix_service.fusion.product.factors import Factor, make_factor
from rayfix_service.fusion.product.prior import Prior, height_prior, uniform_prior
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.fusion.quadrature.engine import GridPosterior, Quadrature
from rayfix_service.fusion.quadrature.observed import path_factor
from rayfix_service.fusion.quadrature.sets import sort_paths, span_of
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_tables.errors import ReportError
from rayfix_tables.site import REACH_DB, Selection, SiteInfo
from rayfix_tables.table import Table

_MOST_MEASUREMENTS = 32
"""A report of more measurements than this is not quick, without a closer estimate."""

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

_COARSER_GRID = "the position's surroundings were divided less finely, since there were too many parts"

_OWN_RULE = (
    "the selection rule of {} was not followed but that of the table, since times on a clock of unknown offset are "
    "located with the table's Gaussians; send paths with toa_m, or times on a known clock"
)

_NO_GAINS = (
    "the table has no gains of the paths of station '{}', which paths are located by; build the table again with this "
    "version, or send aoa and pt of one path"
)

_SINGULAR = (
    "{} Gaussians were left out, since rounding made their covariances singular; give standard deviations that differ "
    "less in size"
)


class Fusion:
    """Multiplies the measurements of reports, with what follows from a table and is worked out once.

    Parameters
    ----------
    table : Table
    settings : FusionSettings
    """

    def __init__(self, table: Table, settings: FusionSettings) -> None:
        self.table = table
        self.settings = settings
        self._uniform_prior = uniform_prior(table.scene.free_space)
        x, y, z = table.scene.origin.tolist()
        self._stations = {name: StationMixtures(part, (x, y, z)) for name, part in table.parts.items()}
        largest = max((part.levels[-1].num_components for part in table.parts.values()), default=0)
        self._most_considered = max(self.settings.most_considered, self.settings.considered_tables * largest)
        self._quadrature = Quadrature(table, settings)
        self._cost = CostEstimate(self._stations, self.settings)

    def seconds(self, report: Report) -> float:
        """Estimate how long a fix of a report will take, s, within some microseconds.

        The estimate separates quick fixes from slow ones; it is infinite for a report that is slow in any case.
        """
        report = with_deviations(report, self.table.site)
        by_station: dict[str, list[MeasuredPath]] = {}
        for measurement in report.measurements:
            if isinstance(measurement, MeasuredPath):
                by_station.setdefault(measurement.station_id, []).append(measurement)
        if by_station:
            within = _within_db(report.selection)
            spans = {name: span_of(paths, within) for name, paths in by_station.items()}
            return self._quadrature.seconds_of_paths(spans, len(report.measurements))
        selections = selections_of(report, self.table.site)
        seconds = (
            self._quadrature.seconds(report, selections) if len(report.measurements) <= _MOST_MEASUREMENTS else None
        )
        return self._cost.seconds(report) if seconds is None else seconds

    def product(
        self, report: Report, stop: Stop = NEVER, *, site: SiteInfo | None = None, on_path_map: bool = True
    ) -> Product:
        """Multiply the likelihoods of the measurements of a report.

        Parameters
        ----------
        report : Report
        site : SiteInfo, optional
            Whose stations the report is of; the table's by default.
        on_path_map : bool
            Whether wide errors are integrated on the path map; otherwise Gaussians are multiplied.
        stop : Stop
            Ends it early, from another thread.

        Raises
        ------
        ReportError
            When the report cannot be used; its ``path`` names the field.
        FixStoppedError
            When it was stopped.
        """
        site = site or self.table.site
        several = paths_and_times(with_deviations(report, site))
        report = several.report
        sorted_report = sort_report(report, site)
        prior = self._prior(report)
        selections = selections_of(report, site)
        check_gains(selections, self.table)
        if several.measured:
            return self._several(sorted_report, several, site, prior, stop, selections)
        if on_path_map and self._quadrature.suits(sorted_report, selections):
            return self._integrated(sorted_report, prior, stop, selections)
        product = self._multiplied(sorted_report, prior, stop)
        if selections:
            product = product._replace(simplified=(*product.simplified, _OWN_RULE.format(", ".join(selections))))
        return product

    def station_factors(self, report: Report, product: Product) -> tuple[StationFactor, ...]:
        """Give the observations of a report, as factors where it was integrated on the path map."""
        exact = (
            isinstance(product.posterior, GridPosterior)
            and all(isinstance(each, Angle | Range) for each in report.measurements)
            and not selections_of(report, self.table.site)
        )
        if not exact:
            return tuple(StationFactor(each.station_id, None) for each in product.observations)
        settings = replace(self.settings, unmodelled_probability=0.0, unmodelled_without_length=0.0)
        longest, origin = self.table.site.max_path_length, self.table.scene.origin
        return tuple(
            StationFactor(
                each.station_id,
                path_factor(
                    each, settings, longest, np.subtract(self.table.parts[each.station_id].station.position, origin)
                ),
            )
            for each in product.observations
        )

    def _prior(self, report: Report) -> Prior:
        prior = self._uniform_prior
        if report.height is not None:
            scene = self.table.scene
            prior = height_prior(report.height, scene.free_space).raised(-float(scene.origin[2]))
        return prior

    def _integrated(
        self, sorted_report: SortedReport, prior: Prior, stop: Stop, selections: Mapping[str, Selection]
    ) -> Product:
        """Integrate the posterior on the path map."""
        observations = list(sorted_report.observations)
        posterior = self._quadrature.posterior(observations, prior, stop, selections)
        simplified = (_COARSER_GRID,) if posterior.omitted else ()
        return Product(observations, dict(sorted_report.unused), prior, posterior, simplified)

    def _several(
        self,
        sorted_report: SortedReport,
        several: PathsAndTimes,
        site: SiteInfo,
        prior: Prior,
        stop: Stop,
        selections: Mapping[str, Selection],
    ) -> Product:
        """Integrate the posterior of a report with several paths of a station, and of what else it has."""
        for index, path in several.measured:
            if not has_gains(self.table, path.station_id):
                raise ReportError(_NO_GAINS.format(path.station_id), path=("measurements", index))
        paths = sort_paths(
            several.measured,
            site,
            within_db=_within_db(several.report.selection),
            spurious_paths=self.settings.spurious_paths,
            single=several.single,
        )
        observations = list(sorted_report.observations)
        unused = {**sorted_report.unused, **paths.unused, **several.unused}
        unused |= {n: unused[index] for index, n in several.single.items() if n is not None and index in unused}
        if not observations and not paths.indices:
            return Product([], unused, prior, None)
        posterior = self._quadrature.posterior(observations, prior, stop, selections, paths)
        for name, index in paths.indices:
            if index in several.single:
                own = Observation(station_id=name, angle_index=several.single[index], timing_indices=(index,))
            else:
                own = Observation(station_id=name, angle_index=index)
            observations.append(own)
        return Product(observations, unused, prior, posterior, (_COARSER_GRID,) if posterior.omitted else ())

    def _multiplied(self, sorted_report: SortedReport, prior: Prior, stop: Stop) -> Product:
        """Multiply the Gaussians of the table's cells."""
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
        if hypotheses is not None and hypotheses.dropped:
            simplified.append(_SINGULAR.format(hypotheses.dropped))
        posterior = None if hypotheses is None else GaussianPosterior(gaussians=hypotheses)
        return Product(observations, unused, prior, posterior, tuple(simplified))

    def _factors(
        self, sorted_report: SortedReport, prior: Prior, unused: dict[int, str], stop: Stop
    ) -> tuple[list[Observation], list[Factor]]:
        """Factors of the observations that can contribute; why others cannot goes to ``unused``."""
        observations, factors = [], []
        unused_differences: dict[int, str] = {}
        left, count = self._most_considered, len(sorted_report.observations)
        for index, observation in enumerate(sorted_report.observations):
            factor = None
            if left > 0:
                factor = make_factor(
                    observation,
                    self._stations[observation.station_id],
                    num_clocks=sorted_report.num_clocks,
                    max_path_length=self.table.site.max_path_length,
                    prior=prior,
                    settings=self.settings,
                    most_considered=left // (count - index),
                    stop=stop,
                )
            if factor is not None:
                left -= factor.considered
                observations.append(observation)
                factors.append(factor)
                continue
            reason = _NO_RAYS.format(observation.station_id) if left > 0 else _TOO_MUCH
            for measured in (observation.angle_index, *observation.timing_indices):
                if measured is not None:
                    unused[measured] = reason
            unused_differences |= dict.fromkeys(observation.differences, reason)
        # A time difference belongs to two paths, and contributes as long as one of them does.
        if unused_differences:
            contributing = {n for o in observations for n in o.differences}
            unused |= {n: unused_differences[n] for n in unused_differences.keys() - contributing}
        return observations, factors


def _within_db(selection: Selection | None) -> float:
    """How weak a measured path may be, dB."""
    return selection.reach_db if selection is not None and selection.rule == "all" else REACH_DB["all"]
