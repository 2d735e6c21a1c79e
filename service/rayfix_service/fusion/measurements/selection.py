"""The rules by which the stations of a report select what they report, where a table was built with others."""

from collections.abc import Mapping

from rayfix_service.fusion.measurements.report import MeasuredPath, Report
from rayfix_tables.errors import ReportError
from rayfix_tables.site import Selection, SiteInfo
from rayfix_tables.table import Table


def selections_of(report: Report, site: SiteInfo) -> Mapping[str, Selection]:
    """Find the stations of a report whose rule is not the table's.

    Parameters
    ----------
    report : Report
        Its rule goes before that of a station.
    site : SiteInfo
        Of the stations.

    Returns
    -------
    mapping of str to Selection
        By the name of the station.

    """
    if report.selection is None and not any(station.selection for station in site.stations):
        return {}
    own = _of_table(site)
    found: dict[str, Selection] = {}
    for measurement in report.measurements:
        station = site.station_by_id.get(measurement.station_id)
        selection = report.selection or (station.selection if station is not None else None)
        if station is None or selection is None or _same(selection, own) or isinstance(measurement, MeasuredPath):
            continue
        found[station.id] = selection
    return found


def check_gains(selections: Mapping[str, Selection], table: Table) -> None:
    """Check that a table has the gains of paths that rules need.

    Raises
    ------
    ReportError
        When it has not.
    """
    for name, selection in selections.items():
        if not has_gains(table, name):
            raise ReportError(
                f"the table has no gains of the paths of station '{name}', which the rule {selection.rule!r} needs; "
                "build the table again with this version, or leave selection out",
                path=("selection",),
            )


def has_gains(table: Table, station_id: str) -> bool:
    """Whether a table has the gains of a station's paths, which tables have since format 4."""
    paths = table.parts[station_id].paths
    return paths is not None and len(paths) > 0 and len(paths.lit) == len(paths)


def _of_table(site: SiteInfo) -> Selection | None:
    """Rule that a table's weights are of, None where they are of none."""
    propagation = site.document.get("propagation", {})
    if propagation.get("path_prior", "power") != "power":
        return None
    return Selection(rule="strongest", exponent=float(propagation.get("path_prior_exponent", 2.0)))


def _same(selection: Selection, own: Selection | None) -> bool:
    # How weak an audible path may be hardly matters to which one is the strongest.
    return own is not None and selection.rule == own.rule and selection.exponent == own.exponent
