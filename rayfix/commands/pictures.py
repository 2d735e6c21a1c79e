"""Pictures: ``rayfix view`` and ``rayfix plot``."""

import argparse
from pathlib import Path

from rayfix.commands.arguments import AddCommand, coordinate, seed_number
from rayfix.extras import needs_extra

_LAYERS = ("rays", "points", "mixture", "posterior", "fix")


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    view = add("view", _view, "write one HTML page with the viewer, a site, and the fixes of a file")
    view.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    view.add_argument("report", type=Path, nargs="?", metavar="REPORT.json", help="a report, or {'reports': [...]}")
    view.add_argument("-o", "--output", type=Path, required=True, metavar="FIX.html", help="the page")

    plot = add("plot", _plot, "draw a report in its scene: rays, points, mixtures, posterior and fix")
    plot.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    plot.add_argument("report", type=Path, metavar="REPORT.json", help="file of the measurements")
    plot.add_argument("-o", "--output", type=Path, required=True, metavar="FIX.png", help=".png, .svg or .pdf")
    plot.add_argument(
        "--layers",
        type=_layers,
        default=("rays", "mixture", "posterior", "fix"),
        metavar="NAMES",
        help=f"what to draw, of {','.join(_LAYERS)} (default: rays,mixture,posterior,fix)",
    )
    plot.add_argument("--truth", type=coordinate, nargs=3, metavar=("X", "Y", "Z"), help="true position, m")
    plot.add_argument("--seed", type=seed_number, default=1, help="seed of rays and points (default: 1)")


def _layers(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise argparse.ArgumentTypeError(f"{text!r} names no layer; give one or more of {','.join(_LAYERS)}")
    if unknown := [name for name in names if name not in _LAYERS]:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not a layer; give one or more of {','.join(_LAYERS)}")
    return names


def _view(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix.view import write_view
    count = write_view(options.table, options.output, options.report)
    fixes = "1 fix" if count == 1 else f"{count or 'no'} fixes"
    print(f"Wrote {options.output} with the site and {fixes}; open it in a browser")
    return 0


def _plot(options: argparse.Namespace) -> int:
    with needs_extra("all"):
        from rayfix.view import read_reports
        from rayfix_evaluation.pictures.files import check_picture
        from rayfix_evaluation.pictures.report_plot import plot_report
        from rayfix_service.locator import Locator
        from rayfix_service.wire import fix_to_document, parse_report
        from rayfix_tables.checked import open_checked
        from rayfix_tables.errors import ReportError
    check_picture(options.output)
    locator = Locator(open_checked(options.table))
    documents = read_reports(options.report)
    if len(documents) != 1:
        raise ReportError(f"{options.report} has {len(documents)} reports; give a file with one")
    report = parse_report(documents[0])
    plot_report(
        options.output,
        locator,
        report,
        fix_to_document(locator.locate(report), 0.0),
        layers=options.layers,
        truth=None if options.truth is None else tuple(options.truth),
        seed=options.seed,
    )
    print(f"Wrote {options.output}")
    return 0
