"""The command line. Every error that rayfix foresees is one line on standard error and exit status 2."""

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from rayfix.cli_pictures import add_picture_commands
from rayfix.extras import needs_extra
from rayfix_tables.errors import RayfixError
from rayfix_tables.version import software_version

if TYPE_CHECKING:
    from rayfix_service.adapters.omlox_hub import HubSettings


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        self.exit(2, f"{self.prog}: {message}; see '{self.prog} --help'\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except RayfixError as error:
        print(f"rayfix: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("rayfix: interrupted; finished work is kept, run the same command again to go on", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="rayfix", description="Indoor position fixes from angles and times of arrival.")
    parser.add_argument("--version", action="version", version=f"rayfix {software_version()}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)

    def add(name: str, run: object, text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        command.set_defaults(run=run)
        return command

    demo = add("demo", _demo, "run the whole main job on the bundled hall and draw a picture of the fix")
    demo.add_argument("-o", "--output", type=Path, default=Path("demo"), metavar="DIR", help="folder (default: demo)")
    demo.add_argument("--jobs", type=_jobs, default=-1, help="cells fitted at a time (default: one per core)")

    example = add("example", _example, "write the bundled hall: hall.glb, site.toml, report.json")
    example.add_argument("folder", type=Path, metavar="DIR")

    check = add("check", _check, "list the problems of a site and its scene, each with its remedy")
    check.add_argument("site", type=Path, metavar="SITE.toml")
    check.add_argument("--json", action="store_true", help="as JSON")

    build = add("build", _build, "build the table of a site")
    build.add_argument("site", type=Path, metavar="SITE.toml")
    build.add_argument("-o", "--output", type=Path, required=True, metavar="T.h5")
    build.add_argument("--jobs", type=_jobs, default=-1, help="cells fitted at a time (default: one per core)")
    build.add_argument("--cluster", metavar="ADDRESS", help="let the workers of this Dask scheduler fit the cells")
    build.add_argument("--former", type=Path, metavar="OLD.h5", help="table to take over from (default: one at T.h5)")
    build.add_argument(
        "--tolerance",
        type=_tolerance,
        default=0.0,
        metavar="SHARE",
        help="also keep cells of the former table whose rays have changed by this share at most, e.g. 0.01; "
        "the table is then no longer exactly that of a whole build, and says so (default: 0)",
    )
    build.add_argument("--no-progress", action="store_true", help="show no progress bar")
    build.add_argument("--json", action="store_true", help="print the summary as JSON")

    info = add("info", _info, "show what a table holds")
    info.add_argument("table", type=Path, metavar="T.h5")
    info.add_argument("--json", action="store_true", help="as JSON")

    verify = add("verify", _verify, "read a whole table and compare its checksums")
    verify.add_argument("table", type=Path, metavar="T.h5")

    locate = add("locate", _locate, "locate the reports of a file")
    locate.add_argument("table", type=Path, metavar="T.h5")
    locate.add_argument("report", type=Path, metavar="REPORT.json")
    locate.add_argument("--format", choices=_INPUTS, default="native", help="format of the report (default: native)")
    _add_output_arguments(locate)
    locate.add_argument("--json", action="store_true", help="the answer of the HTTP interface")

    plan = add("plan", _plan, "forecast errors and coverage over the floor of a table and draw the map")
    plan.add_argument("table", type=Path, metavar="T.h5")
    plan.add_argument("-o", "--output", type=Path, required=True, metavar="MAP.png", help="picture: .png, .svg or .pdf")
    plan.add_argument("--height", type=float, required=True, metavar="Z", help="of the targets in the scene, m")
    plan.add_argument("--azimuth-stdev-deg", type=float, default=1.0, metavar="DEG", help="(default: 1)")
    plan.add_argument("--zenith-stdev-deg", type=float, metavar="DEG", help="(default: that of the azimuth)")
    plan.add_argument("--times", choices=("none", "pt", "toa", "tdoa"), default="none", help="(default: none)")
    plan.add_argument(
        "--range-stdev-m", type=float, default=0.5, metavar="M", help="of times, as length (default: 0.5)"
    )
    plan.add_argument("--beside", type=Path, metavar="OTHER.h5", help="table of the site with a station added or moved")
    plan.add_argument("--spacing-m", type=float, default=0.5, metavar="M", help="side of the squares (default: 0.5)")
    plan.add_argument("--threshold-m", type=float, default=1.0, metavar="M", help="largest useful error (default: 1)")
    plan.add_argument("--draws", type=int, default=4, help="reports from each square (default: 4)")
    plan.add_argument("--seed", type=int, default=1, help="of places and noise (default: 1)")
    plan.add_argument("--no-progress", action="store_true", help="show no progress bar")
    plan.add_argument("--json", action="store_true", help="print the map as JSON, one line for each table")

    add_picture_commands(add)

    serve = add("serve", _serve, "serve a table, or all tables of a folder, over HTTP")
    serve.add_argument("tables", type=Path, metavar="T.h5|DIR")
    serve.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    serve.add_argument("--port", type=int, default=8000, help="port to listen on (default: 8000)")
    serve.add_argument("--workers", type=int, default=1, help="processes that answer (default: 1)")
    serve.add_argument("--log-format", choices=("text", "json"), default="text", help="of the log (default: text)")
    serve.add_argument("--access-log", action="store_true", help="log a line per request")
    serve.add_argument("--track", action="store_true", help="follow targets unless a request says otherwise")
    _add_hub_argument(serve)
    serve.add_argument(
        "--allow-simulation",
        action="store_true",
        help="let the viewer simulate reports (on a loopback address it always may)",
    )
    serve.add_argument(
        "--api-keys", type=Path, metavar="FILE", help="keys to ask for; needed unless only this machine can reach HOST"
    )
    serve.add_argument(
        "--rate-limit", type=_rate, metavar="N", help="reports that each key may send a second (default: no limit)"
    )
    serve.add_argument(
        "--cors-origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="let pages of this origin, e.g. https://maps.example.com, call from browsers; may be given several times",
    )

    api_key = add("api-key", _api_key, "make an API key, print it once, and add its hash to a key file")
    api_key.add_argument("name", metavar="NAME", help="whose it is")
    api_key.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="key file, made if need be")

    evaluate = add("evaluate", _evaluate, "measure how well a site can be located in, and write a report")
    evaluate.add_argument("site", type=Path, metavar="SITE.toml")
    evaluate.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the report")
    evaluate.add_argument("--table", type=Path, metavar="T.h5", help="the site's table (default: it is built)")
    evaluate.add_argument("--quick", action="store_true", help="few drops: some minutes instead of an hour")
    evaluate.add_argument("--drops", type=_drops, metavar="N", help="drops of each study instead of the usual numbers")
    evaluate.add_argument(
        "--seed", type=_seed, default=2026, help="the same seed gives the same results (default: 2026)"
    )
    evaluate.add_argument("--jobs", type=_jobs, default=-1, help="processes (default: one per core)")
    evaluate.add_argument("--no-progress", action="store_true", help="show no progress bar")

    mqtt = add("mqtt", _mqtt, "locate from an MQTT broker: angles of Silicon Labs locators in, positions out")
    mqtt.add_argument("table", type=Path, metavar="T.h5")
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
    _add_output_arguments(mqtt)
    mqtt.add_argument(
        "--window", type=float, default=0.5, help="seconds that a packet waits for more locators (default: 0.5)"
    )
    mqtt.add_argument("--frame", choices=("lcs", "scene", "north"), default="lcs", help="of the angles (default: lcs)")
    mqtt.add_argument("--track", action="store_true", help="follow tags from packet to packet")
    _add_hub_argument(mqtt)
    mqtt.add_argument("--tls", action="store_true", help="encrypt; the port is then 8883 unless given")
    mqtt.add_argument("--username", help=f"the password is taken from the environment variable {_PASSWORD_VARIABLE}")
    return parser


_INPUTS = ("native", "nrppa", "silabs", "ublox")
_OUTPUTS = ("native", "3gpp", "omlox")
_HUB_VARIABLE = "RAYFIX_OMLOX_TOKEN"
_PASSWORD_VARIABLE = "RAYFIX_MQTT_PASSWORD"  # not an argument, which other users of the machine could read


def _add_hub_argument(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--omlox-hub",
        metavar="URL",
        help="also tell this omlox hub of all positions, e.g. http://hub:8081/v2; "
        f"a token is taken from the environment variable {_HUB_VARIABLE}",
    )


def _hub_settings(options: argparse.Namespace) -> "HubSettings | None":
    from rayfix_service.adapters.omlox_hub import HubSettings

    if options.omlox_hub is None:
        return None
    return HubSettings(url=options.omlox_hub, token=os.environ.get(_HUB_VARIABLE))


def _add_output_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("--output", choices=_OUTPUTS, default="native", help="format of the answer (default: native)")
    command.add_argument(
        "--station",
        action="append",
        default=[],
        metavar="NAME=STATION",
        help="the station that the report calls NAME; may be given several times",
    )
    command.add_argument(
        "--height",
        type=float,
        nargs=2,
        metavar=("Z", "STDEV"),
        help="known height of the target in the scene and its standard deviation, m",
    )


def _jobs(text: str) -> int:
    jobs = int(text)
    if jobs == 0 or jobs < -1:
        raise argparse.ArgumentTypeError(f"{jobs} is not a number of jobs; give 1 or more, or -1 for one per core")
    return jobs


def _rate(text: str) -> float:
    rate = float(text)
    if not 0.0 < rate < 1e9:
        raise argparse.ArgumentTypeError(f"{text} is no rate; give a number of reports a second, e.g. 100")
    return rate


def _drops(text: str) -> int:
    drops = int(text)
    if drops < 2:
        raise argparse.ArgumentTypeError(f"{drops} drops have no percentiles; give 2 or more")
    return drops


def _seed(text: str) -> int:
    seed = int(text)
    if seed < 0:
        raise argparse.ArgumentTypeError(f"{seed} is no seed; give 0 or more")
    return seed


def _tolerance(text: str) -> float:
    tolerance = float(text)
    if not 0.0 <= tolerance < 1.0:
        raise argparse.ArgumentTypeError(f"{text} is no share; give 0 or more, below 1, e.g. 0.01")
    return tolerance


def _demo(options: argparse.Namespace) -> int:
    with needs_extra("all"):
        from rayfix.demo import run_demo
    run_demo(options.output, jobs=options.jobs)
    return 0


def _example(options: argparse.Namespace) -> int:
    with needs_extra("offline"):
        from rayfix.example.files import write_example

        site = write_example(options.folder)
    print(f"Wrote {site} with its scene and a report. Next: rayfix build {site} -o {options.folder / 'hall.h5'}")
    return 0


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

    from rayfix.console import build_progress, print_build_summary

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
    from rayfix_tables.table import Table

    table = Table.open(options.table)
    if options.json:
        print(json.dumps(table_info(table), indent=2))
    else:
        print_table_info(table)
    return 0


def _verify(options: argparse.Namespace) -> int:
    from rayfix_tables.table import Table

    table = Table.open(options.table)
    table.verify()
    print(f"{options.table} is whole: table_id {table.table_id}")
    return 0


def _locate(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix.console import print_fix
        from rayfix.locate import locate_file
        from rayfix_service.adapters.adapted import known_height, station_map
    answers = locate_file(
        options.table,
        options.report,
        input_format=options.format,
        output_format=options.output,
        stations=station_map(options.station),
        height=known_height(*(options.height or (None, None))),
    )
    for document in answers:
        if options.json or options.output != "native":
            # Several are one a line, which is what programs read.
            print(json.dumps(document, indent=2 if len(answers) == 1 else None))
        else:
            if len(answers) > 1:
                print(f"{document['target_id']}:")
            print_fix(document)
    return 0


def _plan(options: argparse.Namespace) -> int:
    with needs_extra("all"):
        from rayfix.plan import plan_document, plan_lines, plan_settings, plan_tables
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
    )
    tables = [options.table, *([options.beside] if options.beside else [])]
    maps = plan_tables(tables, settings, options.output, progress=not options.no_progress)
    for line in [json.dumps(plan_document(*each)) for each in maps] if options.json else plan_lines(maps):
        print(line)
    return 0


def _serve(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix_service.http.server import is_loopback, serve
        from rayfix_service.http.settings import ServiceSettings
    serve(
        options.tables,
        host=options.host,
        port=options.port,
        workers=options.workers,
        log_format=options.log_format,
        access_log=options.access_log,
        settings=ServiceSettings(
            api_keys=options.api_keys,
            reports_per_second=options.rate_limit,
            cors_origins=tuple(options.cors_origin),
            track=options.track,
            hub=_hub_settings(options),
            simulation=options.allow_simulation or is_loopback(options.host),
        ),
    )
    return 0


def _api_key(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix_service.http.keys import add_key
    print(add_key(options.output, options.name))
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    with needs_extra("evaluate"):
        from rayfix.evaluation.report.write import PAGE, run_evaluation

    from rayfix.console import evaluation_progress, print_evaluation

    with evaluation_progress(enabled=not options.no_progress) as progress:
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


def _mqtt(options: argparse.Namespace) -> int:
    with needs_extra("mqtt"):
        from rayfix.mqtt import serve_mqtt
        from rayfix_service.adapters.adapted import known_height, station_map
        from rayfix_service.adapters.mqtt import MqttSettings, parse_broker
    broker = parse_broker(
        options.broker,
        tls=options.tls,
        username=options.username,
        password=os.environ.get(_PASSWORD_VARIABLE),
    )
    settings = MqttSettings(
        topic=options.topic,
        publish=options.publish,
        output=options.output,
        window=options.window,
        stations=station_map(options.station),
        frame=options.frame,
        height=known_height(*(options.height or (None, None))),
        track=options.track,
        hub=_hub_settings(options),
    )
    serve_mqtt(options.table, broker, settings)
    return 0
