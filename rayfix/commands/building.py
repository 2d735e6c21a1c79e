"""Tables: ``rayfix check``, ``build``, ``info`` and ``verify``."""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

from rayfix.commands.arguments import (
    TABLE_SUFFIXES,
    AddCommand,
    add_jobs_argument,
    add_progress_argument,
    mass_share,
)
from rayfix.errors import BuildError
from rayfix.extras import needs_extra


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    check = add("check", _check, "list the problems of a site and its scene, each with its remedy")
    check.add_argument("site", type=Path, metavar="SITE.toml", help="site file")
    check.add_argument("--json", action="store_true", help="as JSON")

    build = add("build", _build, "build the table of a site")
    build.add_argument("site", type=Path, metavar="SITE.toml", help="site file")
    build.add_argument("-o", "--output", type=Path, required=True, metavar="T.h5", help="path of the new table")
    add_jobs_argument(build, "cells fitted at a time")
    build.add_argument("--cluster", metavar="ADDRESS", help="let the workers of this Dask scheduler fit the cells")
    build.add_argument(
        "--former", type=Path, metavar="OLD.h5", help="table to reuse cells from (default: the one at T.h5)"
    )
    build.add_argument(
        "--tolerance",
        type=mass_share,
        default=0.0,
        metavar="SHARE",
        help="also keep cells of the former table if their rays have changed by at most this fraction, e.g. 0.01; "
        "the table then differs from that of a new build and records by how much (default: 0)",
    )
    add_progress_argument(build)
    build.add_argument("--json", action="store_true", help="print the summary as JSON")

    info = add("info", _info, "show what a table holds")
    info.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    info.add_argument("--json", action="store_true", help="as JSON")

    verify = add("verify", _verify, "read all of a table and compare its checksums")
    verify.add_argument("table", type=Path, metavar="T.h5", help="table of the site")


def _check(options: argparse.Namespace) -> int:
    with needs_extra("offline"):
        from rayfix_offline.check import check_site

    from rayfix.console import print_check

    check = check_site(options.site)
    if options.json:
        print(json.dumps(check.document(), indent=2))
    else:
        print_check(check)
    return 2 if check.num_errors else 0


def _build(options: argparse.Namespace) -> int:
    with needs_extra("offline"):
        from rayfix_offline.build import build_table

    from rayfix.console import print_build_summary
    from rayfix.progress import build_progress

    if options.output.suffix.lower() not in TABLE_SUFFIXES and not options.output.exists():
        raise BuildError(f"{options.output} is not a valid name of a table; end it in {TABLE_SUFFIXES[0]}")

    with build_progress(enabled=not options.no_progress) as progress:
        summary = build_table(
            options.site,
            options.output,
            jobs=options.jobs,
            cluster=options.cluster,
            former=options.former,
            tolerance=options.tolerance,
            progress=progress,
        )
    for warning in summary.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if options.json:
        print(json.dumps(dataclasses.asdict(summary), indent=2, default=str))
    else:
        print_build_summary(summary)
    return 0


def _info(options: argparse.Namespace) -> int:
    from rayfix.console import print_table_info, table_info
    from rayfix_tables.checked import open_checked

    table = open_checked(options.table, whole=False)
    if options.json:
        print(json.dumps(table_info(table), indent=2))
    else:
        print_table_info(table)
    return 0


def _verify(options: argparse.Namespace) -> int:
    from rayfix_tables.checked import open_checked

    table = open_checked(options.table)
    print(f"{options.table} is intact: table_id {table.table_id}")
    return 0
