"""Accuracy of a site: ``rayfix plan`` and ``rayfix evaluate``."""

import argparse
import json
from pathlib import Path

from rayfix.commands.arguments import (
    AddCommand,
    add_jobs_argument,
    add_progress_argument,
    at_least_one,
    drop_count,
    positive,
    seed_number,
)
from rayfix.extras import needs_extra


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    plan = add("plan", _plan, "forecast errors and coverage over the floor of a table and draw the map")
    plan.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    plan.add_argument("-o", "--output", type=Path, required=True, metavar="MAP.png", help="picture: .png, .svg or .pdf")
    plan.add_argument("--height", type=float, required=True, metavar="Z", help="height (z) of the targets, m")
    plan.add_argument("--azimuth-stdev-deg", type=positive, default=1.0, metavar="DEG", help="(default: 1)")
    plan.add_argument("--zenith-stdev-deg", type=positive, metavar="DEG", help="(default: as the azimuth)")
    plan.add_argument("--times", choices=("none", "pt", "toa", "tdoa"), default="none", help="(default: none)")
    plan.add_argument(
        "--range-stdev-m",
        type=positive,
        default=0.5,
        metavar="M",
        help="standard deviation of times, as length (default: 0.5)",
    )
    plan.add_argument("--beside", type=Path, metavar="OTHER.h5", help="table of the site with a station added or moved")
    plan.add_argument("--spacing-m", type=positive, default=0.5, metavar="M", help="side of the squares (default: 0.5)")
    plan.add_argument(
        "--threshold-m", type=positive, default=1.0, metavar="M", help="largest useful error (default: 1)"
    )
    plan.add_argument("--draws", type=at_least_one, default=4, help="reports from each square (default: 4)")
    plan.add_argument("--seed", type=seed_number, default=1, help="seed of positions and noise (default: 1)")
    plan.add_argument(
        "--paths", type=at_least_one, metavar="K", help="strongest paths that each station reports (default: one path)"
    )
    add_progress_argument(plan)
    plan.add_argument("--json", action="store_true", help="print the map as JSON, one line for each table")

    evaluate = add("evaluate", _evaluate, "measure the accuracy of a site with simulated drops and write a report")
    evaluate.add_argument("site", type=Path, metavar="SITE.toml", help="site file")
    evaluate.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the report")
    evaluate.add_argument("--table", type=Path, metavar="T.h5", help="the site's table (default: it is built first)")
    evaluate.add_argument("--quick", action="store_true", help="few drops: some minutes instead of half an hour")
    evaluate.add_argument("--drops", type=drop_count, metavar="N", help="number of drops of each study")
    evaluate.add_argument(
        "--seed", type=seed_number, default=2026, help="the same seed gives the same results (default: 2026)"
    )
    add_jobs_argument(evaluate, "processes")
    add_progress_argument(evaluate)


def _plan(options: argparse.Namespace) -> int:
    with needs_extra("all"):
        from rayfix_evaluation.planning.plan import plan_document, plan_lines, plan_settings, plan_tables
    settings = plan_settings(
        height=options.height,
        azimuth_stdev_deg=options.azimuth_stdev_deg,
        zenith_stdev_deg=options.zenith_stdev_deg,
        timing=options.times,
        range_stdev=options.range_stdev_m,
        spacing=options.spacing_m,
        threshold=options.threshold_m,
        draws=options.draws,
        seed=options.seed,
        paths=options.paths,
    )
    tables = [options.table, *([options.beside] if options.beside else [])]
    maps = plan_tables(tables, settings, options.output, progress=not options.no_progress)
    for line in [json.dumps(plan_document(*each)) for each in maps] if options.json else plan_lines(maps):
        print(line)
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    with needs_extra("evaluate"):
        from rayfix_evaluation.report.write import PAGE, run_evaluation

    from rayfix.console import print_evaluation
    from rayfix.progress import stage_progress

    with stage_progress(enabled=not options.no_progress) as progress:
        found = run_evaluation(
            options.site,
            options.output,
            table_path=options.table,
            quick=options.quick,
            drops=options.drops,
            seed=options.seed,
            jobs=options.jobs,
            progress=progress,
        )
    print_evaluation(found.results, options.output / PAGE)
    return 0
