"""Positions of reports, by a table."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rayfix_service.batch import locate_batch
from rayfix_service.fusion.diagnosis.suspects import suspects
from rayfix_service.fusion.diagnosis.turned import find_turns, turn_warning, turned_report
from rayfix_service.fusion.fusion import Fusion
from rayfix_service.fusion.measurements.checks import check_report
from rayfix_service.fusion.measurements.report import Angle, MeasuredPath, Range, Report, TimeOfArrival
from rayfix_service.fusion.measurements.selection import has_gains
from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.posterior.fixes import Product, make_fix
from rayfix_service.fusion.posterior.fused import Fused
from rayfix_service.fusion.posterior.points import DrawnPoints
from rayfix_service.fusion.posterior.posterior import Posterior, make_posterior
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_service.wire import parse_report
from rayfix_tables.errors import ReportError
from rayfix_tables.gaussians.compilation import watch_compilation
from rayfix_tables.table import Table


class Locator:
    """Answers reports from a table.

    Positions that go in and come out are in the scene's frame. In between they are in the table's, which is the same
    but for scenes on map coordinates.

    Parameters
    ----------
    table : Table
        From ``rayfix.build`` or ``rayfix.Table.open``.
    settings : FusionSettings, optional

    Raises
    ------
    TypeError
        When the table is something else, such as the path of one.
    """

    def __init__(self, table: Table, settings: FusionSettings | None = None) -> None:
        if not isinstance(table, Table):
            raise TypeError(f"a Locator needs an open table, not {table!r}; open the file with rayfix.Table.open(path)")
        watch_compilation()
        self.table = table
        self.settings = settings or FusionSettings()
        self._fusion = Fusion(table, self.settings)

    def locate(self, report: Report | Mapping[str, Any], *, stop: Stop = NEVER) -> Fix:
        """Fuse the measurements of a report.

        Parameters
        ----------
        report : Report or mapping
            A mapping has the form of the JSON that ``POST /v1/positions`` takes.
        stop : Stop
            Ends it early, once another thread calls ``stop.set()``.

        Raises
        ------
        ReportError
            When the report cannot be used; its ``path`` names the field.
        FixStoppedError
            When it was stopped.
        """
        report = _read(report)
        return self.explain(report, self._fix(report, self._fusion.product(report, stop), stop), stop=stop)

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
        if any(isinstance(measurement, MeasuredPath) for measurement in report.measurements):
            return fix  # the search is one with Gaussians, of one path of each station

        def relocate(changed: Report, turns: Mapping[str, float]) -> Fix:
            changed, site = turned_report(changed, self.table.site, turns)
            # Times alone decide on turns, and the search was judged with their Gaussians.
            product = self._fusion.product(changed, stop, site=site, on_path_map=False)
            return make_fix(changed, product, self.table, self.settings, stop)

        turns = find_turns(report, fix, self.table.site, relocate, most_fixes=self.settings.most_turn_fixes)
        return replace(fix, warnings=(*fix.warnings, turn_warning(turns))) if turns else fix

    def locate_batch(self, reports: Sequence[Report | Mapping[str, Any]], *, jobs: int = -1) -> list[Fix | ReportError]:
        """Fuse the measurements of many reports, on several processor cores.

        Parameters
        ----------
        reports : sequence of Report or mapping
            As of :meth:`locate`.
        jobs : int
            Processes; -1 for one per core. With 1, everything happens in this one, as it does with 64 reports or fewer.
            Others start with the first call, within seconds, and wait for the next for some minutes.

        Returns
        -------
        list of Fix or ReportError
            Of each report in turn what :meth:`locate` returns or raises.

        Raises
        ------
        TableError
            When the file of the locator's table is no longer that table.
        RayfixError
            When a process ends early.
        """
        return locate_batch(self, reports, jobs=jobs)

    def fuse(self, report: Report | Mapping[str, Any], *, with_likelihood: bool = True, stop: Stop = NEVER) -> Fused:
        """Locate a report and keep its likelihood, for :class:`~rayfix_service.tracking.tracker.Tracker`.

        It does not :meth:`explain` the fix.

        Parameters
        ----------
        report : Report or mapping
        with_likelihood : bool
            Whether the likelihood is kept. For a report with a known height that takes as long as the fix.
        stop : Stop
            As of :meth:`locate`, and so are the errors.
        """
        report = _read(report)
        product = self._fusion.product(report, stop)
        fix = self._fix(report, product, stop)
        hypotheses = likelihood = product.hypotheses
        if not with_likelihood:
            likelihood = None
        elif report.height is not None:
            likelihood = self._fusion.product(replace(report, height=None), stop).hypotheses
        factors = self._fusion.station_factors(report, product) if with_likelihood else ()
        return Fused(fix=fix, hypotheses=hypotheses, prior=product.prior, likelihood=likelihood, factors=factors)

    def posterior(self, report: Report | Mapping[str, Any], *, stop: Stop = NEVER) -> Posterior:
        """Fuse the measurements of a report into the density of the UE's position, for pictures and samples.

        Parameters
        ----------
        report : Report or mapping
        stop : Stop
            As of :meth:`locate`, and so are the errors.
        """
        product = self._fusion.product(_read(report), stop)
        scene = self.table.scene
        posterior = make_posterior(product.hypotheses, product.prior, scene.free_space_in_table_frame, stop)
        return posterior.moved(scene.origin)

    def seconds(self, report: Report, *, with_likelihood: bool = False) -> float:
        """Estimate how long a fix of a report will take, s, within some microseconds.

        The estimate separates quick fixes from slow ones; it is infinite for a report that is slow in any case.

        Parameters
        ----------
        report : Report
        with_likelihood : bool
            Whether :meth:`fuse` is to keep the likelihood, which is a second product for a report with a known height.
        """
        seconds = self._fusion.seconds(report)
        if with_likelihood and report.height is not None:
            seconds += self._fusion.seconds(replace(report, height=None))
        return seconds

    def warm_up(self) -> None:
        """Compile the kernels and prepare reports without angles, by locating a report of each kind."""
        _ = self.table.scene.free_space_in_table_frame.points_all_over
        stations = self.table.site.stations
        window = self.table.parts[stations[0].id].levels[0].window
        for station in stations:
            length = Range(station_id=station.id, path_length=5.0, stdev=0.5)
            self.locate(Report(measurements=(length,)))
            self.seconds(Report(measurements=(length,)))
            for stdev in (0.5 * window, window, 2.0 * window):  # looked up in one cell, in several, on the path map
                angle = Angle(station_id=station.id, azimuth=0.5, zenith=1.8, azimuth_stdev=stdev, zenith_stdev=stdev)
                self.locate(Report(measurements=(angle, length)))
            if station is not stations[0]:  # lengths of a station whose angle was not measured; unknown clocks
                arrival = TimeOfArrival(station_id=station.id, path_length=5.0, stdev=0.5)
                at_first = Range(station_id=stations[0].id, path_length=5.0, stdev=0.5)
                self.locate(Report(measurements=(angle, at_first)))
                self.locate(Report(measurements=(angle, arrival, replace(arrival, station_id=stations[0].id))))
        if has_gains(self.table, stations[0].id):
            path = MeasuredPath(station_id=stations[0].id, azimuth=0.5, azimuth_stdev=window, length=5.0, stdev=0.5)
            self.locate(Report(measurements=(path, replace(path, azimuth=0.6))))
        points = DrawnPoints(mean=np.zeros((1, 3)), root=np.eye(3)[None], owner=np.zeros(8, np.int16))
        regions = CredibleRegions(position=np.zeros(3), covariance=np.eye(3), points=points, share=1.0)
        regions.upright_ellipsoid(0.5)
        _ = regions.accuracies(0.5).ellipsoid.semi_axes

    def _fix(self, report: Report, product: Product, stop: Stop) -> Fix:
        fix = make_fix(report, product, self.table, self.settings, stop)
        return replace(fix, warnings=(suspects(report, fix),)) if fix.status == "inconsistent" else fix


def _read(report: Report | Mapping[str, Any]) -> Report:
    """Check a report, or read one from a mapping."""
    return check_report(report) if isinstance(report, Report) else parse_report(report)
