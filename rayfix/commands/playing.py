"""Logs and services: ``rayfix replay`` and ``rayfix record``."""

import argparse
import os
from pathlib import Path

from rayfix.commands.arguments import AddCommand, at_least_one, positive
from rayfix.errors import ReportError
from rayfix.extras import needs_extra

_KEY_VARIABLE = "RAYFIX_API_KEY"


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    replay = add(
        "replay", _replay, "send the reports of recorded logs to a service, as far apart as they were recorded"
    )
    replay.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="logs of reports, JSON")
    _add_service_arguments(replay)
    replay.add_argument(
        "--speed", type=positive, default=1.0, metavar="X", help="how many times faster than recorded (default: 1)"
    )
    replay.add_argument("--at-once", action="store_true", help="as fast as the service answers")
    replay.add_argument("--track", action="store_true", help="let the service follow the targets")

    record = add("record", _record, "write the reports that a service locates to a log, until it is interrupted")
    record.add_argument(
        "-o", "--output", type=Path, required=True, metavar="LOG.jsonl", help="log, added to if it is there"
    )
    _add_service_arguments(record)
    record.add_argument("--target", metavar="NAME", help="of this target only")
    record.add_argument("--reports", type=at_least_one, metavar="N", help="end after so many (default: go on)")


def _add_service_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--url",
        default="http://localhost:8000",
        help="address of the service (default: http://localhost:8000); "
        f"an API key is taken from the environment variable {_KEY_VARIABLE}",
    )
    command.add_argument("--table", metavar="NAME", help="table of the service, where it has several")


def _replay(options: argparse.Namespace) -> int:
    with needs_extra("client"):
        from rayfix.client import Client
    with needs_extra("service"):
        from rayfix.logs.reading import Reading
        from rayfix.logs.replay import replay_logs
    key = os.environ.get(_KEY_VARIABLE)
    speed = float("inf") if options.at_once else options.speed
    with Client(options.url, api_key=key, table=options.table, track=options.track or None) as client:
        found = replay_logs(options.logs, client, reading=Reading(), speed=speed)
    print(f"{found.sent} reports sent, {found.refused} refused; {found.problems} entries that are no reports")
    if found.latest > 0.5:
        print(f"the service fell behind the log by up to {found.latest:.1f} s")
    return 0


def _record(options: argparse.Namespace) -> int:
    with needs_extra("client"):
        from rayfix.client import Client
    with needs_extra("service"):
        from rayfix.logs.replay import record_reports
    key = os.environ.get(_KEY_VARIABLE)
    try:
        file = options.output.open("ab")
    except OSError as error:
        raise ReportError(f"{options.output} cannot be written ({error.strerror}); give another file") from error
    with file, Client(options.url, api_key=key, table=options.table) as client:
        count = record_reports(client.fixes(options.target), file, most=options.reports)
    print(f"{count} reports in {options.output}")
    return 0
