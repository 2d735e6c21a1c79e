"""Sites from logs: ``rayfix calibrate`` and ``rayfix score``."""

import argparse
import json
from pathlib import Path

from rayfix.commands.arguments import AddCommand, add_progress_argument, positive
from rayfix.commands.logs import add_source_arguments, log_reading
from rayfix.extras import needs_extra


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    calibrate = add("calibrate", _calibrate, "find biases, mountings and deviations of stations from recorded logs")
    calibrate.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    calibrate.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="logs, as those of rayfix locate")
    calibrate.add_argument(
        "--truth",
        type=Path,
        metavar="TRUTH.csv",
        help="true positions: x_m, y_m, z_m and timestamp, or start and end; without it, deviations alone are found",
    )
    calibrate.add_argument(
        "-o", "--site", type=Path, required=True, metavar="SITE.toml", help="site file to write, with what was found"
    )
    calibrate.add_argument("--pictures", type=Path, metavar="DIR", help="folder for pictures of the errors")
    add_source_arguments(calibrate)
    calibrate.add_argument(
        "--longest-gap",
        type=positive,
        default=2.0,
        metavar="S",
        help="time between points of the truth up to which targets moved evenly, s (default: 2)",
    )
    add_progress_argument(calibrate)
    calibrate.add_argument("--json", action="store_true", help="print what was found as JSON")

    score = add("score", _score, "compare fixes of a log with true positions")
    score.add_argument("fixes", type=Path, metavar="FIXES", help="written by rayfix locate -o")
    score.add_argument(
        "truth",
        type=Path,
        metavar="TRUTH.csv",
        help="true positions: x_m, y_m, z_m and timestamp, or start and end; also target_id",
    )
    score.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder for score.html, score.png and score.json"
    )
    score.add_argument(
        "--longest-gap",
        type=positive,
        default=2.0,
        metavar="S",
        help="time between points of the truth up to which targets moved evenly, s (default: 2; more for way-points)",
    )
    score.add_argument("--track", action="store_true", help="score the positions of tracks")
    score.add_argument("--json", action="store_true", help="print the figures as JSON")


def _calibrate(options: argparse.Namespace) -> int:
    with needs_extra("evaluate"):
        from rayfix.calibrate import calibrate_logs, calibration_lines
        from rayfix_service.adapters.adapted import known_height
        from rayfix_tables.checked import open_checked

    from rayfix.progress import stage_progress

    table = open_checked(options.table)
    with stage_progress(enabled=not options.no_progress) as progress:
        found = calibrate_logs(
            table,
            options.logs,
            options.site,
            reading=log_reading(options, table),
            truth_path=options.truth,
            height=known_height(*(options.height or (None, None))),
            longest_gap=options.longest_gap,
            pictures=options.pictures,
            progress=progress,
        )
    if options.json:
        print(json.dumps(found.document, indent=2))
    else:
        for line in calibration_lines(found):
            print(line)
    return 0


def _score(options: argparse.Namespace) -> int:
    with needs_extra("evaluate"):
        from rayfix.score import score_fixes, score_lines
    score = score_fixes(
        options.fixes, options.truth, options.output, longest_gap=options.longest_gap, use_track=options.track
    )
    if options.json:
        print(json.dumps(score.document, indent=2))
    else:
        for line in score_lines(score):
            print(line)
    return 0
