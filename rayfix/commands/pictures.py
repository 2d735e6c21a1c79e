"""Pictures: ``rayfix view`` and ``rayfix plot``."""

import argparse
from pathlib import Path

from rayfix.commands.arguments import AddCommand, coordinate, positive, seed_number
from rayfix.errors import ReportError
from rayfix.extras import needs_extra

_LAYERS = ("rays", "points", "mixture", "posterior", "fix")


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    view = add("view", _view, "write one HTML page with the viewer, a site, and the fixes of a file")
    view.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    view.add_argument("report", type=Path, nargs="?", metavar="REPORT.json", help="a report, or {'reports': [...]}")
    view.add_argument("-o", "--output", type=Path, required=True, metavar="FIX.html", help="the page")
    view.add_argument(
        "--fixes", type=Path, metavar="FIXES.jsonl", help="fixes of a log, by 'rayfix locate -o', which the page plays"
    )
    view.add_argument("--truth", type=Path, metavar="TRUTH.csv", help="where the targets of these fixes really were")
    view.add_argument(
        "--longest-gap",
        type=positive,
        default=2.0,
        metavar="S",
        help="time between two points of the truth, up to which a target moved evenly, s (default: 2)",
    )

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
        from rayfix.viewing.page import write_view
    recording = None
    if options.fixes is not None:
        with needs_extra("all"):
            from rayfix.viewing.recording import read_recording
        recording = read_recording(options.fixes, options.truth, longest_gap=options.longest_gap)
    elif options.truth is not None:
        raise ReportError("--truth is for the fixes of a log; give them by --fixes")
    view = write_view(options.table, options.output, options.report, recording=recording)
    count = view.num_fixes
    fixes = "1 fix" if count == 1 else f"{count or 'no'} fixes"
    print(f"Wrote {options.output} with the site and {fixes}; open it in a browser")
    if view.num_of_other_table:
        print(f"{view.num_of_other_table} of them were made with another table than {options.table}")
    return 0


def _plot(options: argparse.Namespace) -> int:
    with needs_extra("all"):
        from rayfix.viewing.page import read_reports
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
