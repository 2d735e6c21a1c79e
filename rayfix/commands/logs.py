"""Options of commands that read recorded logs."""

import argparse
from typing import TYPE_CHECKING

from rayfix.commands.arguments import positive
from rayfix.errors import ReportError
from rayfix.extras import needs_extra

if TYPE_CHECKING:
    from rayfix.logs.reading import Reading
    from rayfix_service.adapters.ublox import AngleErrors
    from rayfix_tables.table import Table


INPUTS = ("native", "nrppa", "silabs", "ublox")
"""Formats of reports."""


def add_log_arguments(command: argparse.ArgumentParser) -> None:
    """Add the options for how logs are read."""
    command.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="the column of a CSV log that holds NAME, e.g. azimuth_deg=az; may be given several times",
    )
    command.add_argument(
        "--value",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a value that all rows of a CSV log have, e.g. azimuth_stdev_deg=5; may be given several times",
    )
    command.add_argument(
        "--window", type=positive, metavar="S", help="join the reports of a target within this time of a log, s"
    )
    command.add_argument(
        "--combine",
        choices=("median", "mean", "none"),
        default=None,
        help="what joined measurements of a station become; none keeps them all (default: median)",
    )


def add_source_arguments(command: argparse.ArgumentParser) -> None:
    """Add the options for what logs are of, and for how they are read."""
    command.add_argument("--format", choices=INPUTS, default="native", help="format of the logs (default: native)")
    command.add_argument(
        "--station", action="append", default=[], metavar="NAME=STATION", help="the station with the name NAME in a log"
    )
    command.add_argument(
        "--stdev", type=float, metavar="DEG", help="standard deviation of the angles of u-blox lines (default: 10)"
    )
    command.add_argument(
        "--tails",
        type=float,
        nargs=2,
        metavar=("SHARE", "SCALE"),
        help="tails of the angles of u-blox lines (default: 0.2 3)",
    )
    command.add_argument(
        "--height", type=float, nargs=2, metavar=("Z", "STDEV"), help="known height (z) of the targets, m"
    )
    add_log_arguments(command)


def angle_errors(options: argparse.Namespace) -> "AngleErrors | None":
    """Return the errors of u-blox lines that the options state, or None."""
    from rayfix_service.adapters.ublox import USUAL_ERRORS, AngleErrors

    if options.stdev is None and options.tails is None:
        return None
    share, scale = options.tails or (USUAL_ERRORS.tail_share, USUAL_ERRORS.tail_scale)
    stdev = USUAL_ERRORS.stdev_deg if options.stdev is None else options.stdev
    return AngleErrors(stdev_deg=stdev, tail_share=share, tail_scale=scale)


def check_one_report(options: argparse.Namespace) -> None:
    """Refuse options of logs where one report is to be printed.

    Raises
    ------
    ReportError
    """
    if len(options.reports) > 1:
        raise ReportError(f"{len(options.reports)} files are given; name the file of their fixes by -o")
    names = ("column", "value", "window", "combine", "track", "with_reports")
    given = [f"--{name.replace('_', '-')}" for name in names if getattr(options, name)]
    if given:
        raise ReportError(f"{given[0]} is for logs; name the file of their fixes by -o")


def log_reading(options: argparse.Namespace, table: "Table") -> "Reading":
    """Return how the options want logs to be read.

    Raises
    ------
    ReportError
        When options do not fit together, or name what is not there.
    """
    with needs_extra("service"):
        from rayfix.logs.csv_logs import CsvColumns, column_pairs
        from rayfix.logs.reading import Reading
        from rayfix_service.adapters.adapted import check_stations, station_map
        from rayfix_service.adapters.ublox import USUAL_ERRORS
    if options.combine is not None and options.window is None:
        raise ReportError("--combine says what becomes of joined reports; give --window as well")
    errors = angle_errors(options)
    if errors is not None and options.format != "ublox":
        raise ReportError(
            f"{options.format} reports state the errors of their angles; --stdev and --tails are for u-blox lines"
        )
    names, values = column_pairs(options.column, "--column"), column_pairs(options.value, "--value")
    if (names or values) and options.format != "native":
        raise ReportError(f"--column and --value are for logs in CSV, not for --format {options.format}")
    stations = station_map(options.station)
    check_stations(stations, table.parts)
    return Reading(
        input_format=options.format,
        columns=CsvColumns(names=names, values=values),
        stations=stations,
        errors=errors or USUAL_ERRORS,
        window=options.window,
        combine=options.combine or "median",
    )
