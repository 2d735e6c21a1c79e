"""Positions: ``rayfix locate`` and ``rayfix mqtt``."""

import argparse
import json
import os
from pathlib import Path

from rayfix.commands.arguments import (
    AddCommand,
    add_confidence_argument,
    add_hub_argument,
    add_jobs_argument,
    add_output_arguments,
    add_progress_argument,
    at_least_one,
    hub_settings,
)
from rayfix.commands.broker import PASSWORD_VARIABLE
from rayfix.commands.logs import INPUTS, add_log_arguments, angle_errors, check_one_report, log_reading
from rayfix.extras import needs_extra


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    locate = add("locate", _locate, "locate a report, or all reports of recorded logs")
    locate.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    locate.add_argument(
        "reports", type=Path, nargs="+", metavar="LOG", help="file with a report, or logs: JSON or CSV, also gzip"
    )
    locate.add_argument(
        "-o",
        "--fixes",
        type=Path,
        metavar="FIXES",
        help="write the fixes of all reports to this file: .jsonl, .csv, .geojson or .parquet; "
        "without it, one report is located and printed",
    )
    locate.add_argument("--format", choices=INPUTS, default="native", help="format of the reports (default: native)")
    add_output_arguments(locate)
    add_confidence_argument(locate)
    locate.add_argument(
        "--stdev", type=float, metavar="DEG", help="standard deviation of the angles of u-blox lines (default: 10)"
    )
    locate.add_argument(
        "--tails",
        type=float,
        nargs=2,
        metavar=("SHARE", "SCALE"),
        help="probability that such an error has a wider Gaussian distribution, and by what factor it is wider "
        "(default: 0.2 3)",
    )
    locate.add_argument(
        "--json",
        action="store_true",
        help="print the answer, or the summary of logs, as JSON, as the HTTP interface does",
    )
    add_log_arguments(locate)
    locate.add_argument("--track", action="store_true", help="follow the targets of logs from report to report")
    locate.add_argument(
        "--with-reports",
        action="store_true",
        help="write each fix's report beside it, into .jsonl; the viewer needs it",
    )
    add_jobs_argument(locate, "processes that locate the reports of logs")
    add_progress_argument(locate)

    mqtt = add("mqtt", _mqtt, "locate from an MQTT broker: read angles of Silicon Labs locators, publish positions")
    mqtt.add_argument("table", type=Path, metavar="T.h5", help="table of the site")
    mqtt.add_argument("--broker", default="localhost", metavar="HOST[:PORT]", help="(default: localhost)")
    mqtt.add_argument(
        "--topic",
        default="silabs/aoa/angle/+/+",
        help="angles to read, of topics that end in LOCATOR/TAG (default: silabs/aoa/angle/+/+)",
    )
    mqtt.add_argument(
        "--publish",
        default="rayfix/position/{target_id}",
        metavar="TOPIC",
        help="topic of positions (default: rayfix/position/{target_id})",
    )
    add_output_arguments(mqtt)
    add_confidence_argument(mqtt)
    mqtt.add_argument(
        "--window", type=float, default=0.5, help="seconds to wait for more locators' angles of a packet (default: 0.5)"
    )
    mqtt.add_argument(
        "--frame", choices=("lcs", "scene", "north"), default="lcs", help="frame of the angles (default: lcs)"
    )
    mqtt.add_argument("--track", action="store_true", help="track tags from packet to packet")
    add_hub_argument(mqtt)
    mqtt.add_argument("--tls", action="store_true", help="use TLS; the default port is then 8883")
    mqtt.add_argument(
        "--payload-kib", type=at_least_one, default=64, metavar="N", help="longest message, KiB (default: 64)"
    )
    mqtt.add_argument("--username", help=f"the password is taken from the environment variable {PASSWORD_VARIABLE}")


def _locate(options: argparse.Namespace) -> int:
    if options.fixes is not None:
        return _locate_logs(options)
    check_one_report(options)
    with needs_extra("service"):
        from rayfix.console import print_fix
        from rayfix.locate import locate_file
        from rayfix_service.adapters.adapted import known_height, station_map
    answers = locate_file(
        options.table,
        options.reports[0],
        input_format=options.format,
        output_format=options.output,
        stations=station_map(options.station),
        height=known_height(*(options.height or (None, None))),
        confidence=options.confidence,
        errors=angle_errors(options),
    )
    for document in answers:
        if options.json or options.output != "native":
            # Several answers are written as JSON lines.
            print(json.dumps(document, indent=2 if len(answers) == 1 else None))
        else:
            if len(answers) > 1:
                print(f"{document['target_id']}:")
            print_fix(document)
    return 0


def _locate_logs(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix.logs.entries import Task
        from rayfix.logs.layouts import layout_of
        from rayfix.logs.run import locate_logs
        from rayfix_service.adapters.adapted import known_height
        from rayfix_tables.checked import open_checked

    from rayfix.console_logs import print_log_run
    from rayfix.progress import stage_progress

    layout = layout_of(options.fixes)
    table = open_checked(options.table)
    task = Task(
        table_path=options.table.resolve(),
        table_id=table.table_id,
        layout=layout,
        output_format=options.output,
        height=known_height(*(options.height or (None, None))),
        confidence=options.confidence,
        track=options.track,
        with_reports=options.with_reports,
    )
    reading = log_reading(options, table)
    with stage_progress(enabled=not options.no_progress) as progress:
        run = locate_logs(
            table, options.reports, options.fixes, task=task, reading=reading, jobs=options.jobs, progress=progress
        )
    print_log_run(run, options.fixes, as_json=options.json)
    return 0 if run.summary.fixes else 1


def _mqtt(options: argparse.Namespace) -> int:
    with needs_extra("mqtt"):
        from rayfix.mqtt import serve_mqtt
        from rayfix_service.adapters.adapted import known_height, station_map
        from rayfix_service.adapters.mqtt.settings import MqttSettings, parse_broker
    broker = parse_broker(
        options.broker,
        tls=options.tls,
        username=options.username,
        password=os.environ.get(PASSWORD_VARIABLE),
    )
    settings = MqttSettings(
        topic=options.topic,
        publish=options.publish,
        output=options.output,
        window=options.window,
        stations=station_map(options.station),
        frame=options.frame,
        height=known_height(*(options.height or (None, None))),
        confidence=options.confidence,
        track=options.track,
        hub=hub_settings(options),
        payload_bytes=options.payload_kib << 10,
    )
    serve_mqtt(options.table, broker, settings)
    return 0
