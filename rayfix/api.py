"""The Python interface: build a table, locate reports. Everything here needs an extra."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rayfix.extras import needs_extra
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table

with needs_extra("service"):
    from rayfix_service.batch import locate_batch
    from rayfix_service.fusion.locator import Fused
    from rayfix_service.fusion.locator import Locator as _Locator
    from rayfix_service.fusion.measurements.checks import check_report
    from rayfix_service.fusion.measurements.report import Report
    from rayfix_service.fusion.posterior.fix import Fix
    from rayfix_service.fusion.posterior.posterior import Posterior
    from rayfix_service.fusion.settings import FusionSettings
    from rayfix_service.fusion.stopping import NEVER, Stop
    from rayfix_service.tracking.settings import TrackingSettings
    from rayfix_service.tracking.tracker import Tracker as _Tracker
    from rayfix_service.wire import parse_report

__all__ = ["Locator", "Tracker", "build"]


def build(
    site_path: str | Path,
    table_path: str | Path | None = None,
    *,
    jobs: int = -1,
    former: str | Path | None = None,
    tolerance: float = 0.0,
) -> Table:
    """Build a site's table and open it.

    Parameters
    ----------
    site_path : str or Path
        Site file.
    table_path : str or Path, optional
        Where the table goes; beside the site file, with the suffix ``.h5``, when left out.
    jobs : int
        Cells that are fitted at a time; -1 for one per core.
    former : str or Path, optional
        Table from which whatever still holds is taken; one at ``table_path`` when left out.
    tolerance : float
        Fraction of a cell's mass, 0 or more and below 1, that may have changed before a cell of the former table is
        fitted again. With 0, the table is that of a whole build.

    Raises
    ------
    SiteError, SceneError, BuildError, TableError
    """
    with needs_extra("offline"):
        from rayfix_offline.build import build_table

    table_path = Path(table_path) if table_path is not None else Path(site_path).with_suffix(".h5")
    build_table(site_path, table_path, jobs=jobs, former=former, tolerance=tolerance)
    return Table.open(table_path)


class Locator(_Locator):
    """Answers reports from a table.

    Parameters
    ----------
    table : Table
        From :func:`build` or ``Table.open``.
    settings : FusionSettings, optional

    Raises
    ------
    TypeError
        When the table is something else, such as the path of one.
    """

    def __init__(self, table: Table, settings: FusionSettings | None = None) -> None:
        if not isinstance(table, Table):
            raise TypeError(f"a Locator needs an open table, not {table!r}; open the file with rayfix.Table.open(path)")
        super().__init__(table, settings)

    def locate(self, report: Report | Mapping[str, Any], *, stop: Stop = NEVER) -> Fix:
        """Fuse the measurements of a report.

        Parameters
        ----------
        report : Report or mapping
            A mapping has the form of the JSON that ``POST /v1/positions`` takes.
        stop : rayfix_service.fusion.stopping.Stop, optional
            Ends it early, once another thread calls ``stop.set()``.

        Raises
        ------
        ReportError
            When the report cannot be used; its ``path`` names the field.
        FixStoppedError
            When it was stopped.
        """
        return super().locate(_read(report), stop=stop)

    def locate_batch(self, reports: Sequence[Report | Mapping[str, Any]], *, jobs: int = -1) -> list[Fix | ReportError]:
        """Fuse the measurements of many reports, on several processor cores.

        Parameters
        ----------
        reports : sequence of Report or mapping
            Mappings have the form of the JSON that ``POST /v1/positions`` takes.
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

    def posterior(self, report: Report | Mapping[str, Any], *, stop: Stop = NEVER) -> Posterior:
        """Fuse the measurements of a report into the density of the UE's position, for pictures and samples.

        Parameters
        ----------
        report : Report or mapping
            As of :meth:`locate`, and so are the errors.
        stop : rayfix_service.fusion.stopping.Stop, optional
            As of :meth:`locate`.
        """
        return super().posterior(_read(report), stop=stop)

    def fuse(self, report: Report | Mapping[str, Any], *, stop: Stop = NEVER) -> Fused:
        """Fuse the measurements of a report and keep its likelihood, for :class:`Tracker`.

        Parameters
        ----------
        report : Report or mapping
            As of :meth:`locate`, and so are the errors.
        stop : rayfix_service.fusion.stopping.Stop, optional
            As of :meth:`locate`.
        """
        return super().fuse(_read(report), stop=stop)


def _read(report: Report | Mapping[str, Any]) -> Report:
    """Check a report, or read one from a mapping."""
    return check_report(report) if isinstance(report, Report) else parse_report(report)


class Tracker(_Tracker):
    """Follows targets from report to report; see docs/tracking.md.

    Parameters
    ----------
    table : Table
        Its walls block the motion of targets.
    settings : TrackingSettings, optional
    """

    def __init__(self, table: Table, settings: TrackingSettings | None = None) -> None:
        super().__init__(table.scene, settings)
