"""The service: ``rayfix serve`` and ``rayfix api-key``."""

import argparse
from pathlib import Path

from rayfix.commands.arguments import (
    AddCommand,
    add_hub_argument,
    at_least_one,
    hub_settings,
    positive,
    report_rate,
    web_origin,
    web_prefix,
)
from rayfix.commands.broker import add_service_broker_arguments, mqtt_source
from rayfix.extras import needs_extra


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    serve = add("serve", _serve, "serve a table, or all tables of a folder, over HTTP")
    serve.add_argument("tables", type=Path, metavar="T.h5|DIR", help="table, or folder of tables *.h5")
    serve.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    serve.add_argument("--port", type=int, default=8000, help="port to listen on (default: 8000)")
    serve.add_argument("--workers", type=int, default=1, help="number of worker processes (default: 1)")
    serve.add_argument(
        "--log-format", choices=("text", "json"), default="text", help="format of the log (default: text)"
    )
    serve.add_argument("--access-log", action="store_true", help="log a line per request")
    serve.add_argument(
        "--track", action="store_true", help="follow targets unless a request says otherwise; with one worker"
    )
    add_hub_argument(serve)
    serve.add_argument(
        "--allow-simulation",
        action="store_true",
        help="let the viewer simulate reports (on a loopback address it always may)",
    )
    serve.add_argument(
        "--api-keys",
        type=Path,
        metavar="FILE",
        help="file of accepted API keys; required unless HOST is a loopback address",
    )
    serve.add_argument(
        "--rate-limit",
        type=report_rate,
        metavar="N",
        help="reports per second that each key may send (default: no limit)",
    )
    serve.add_argument(
        "--cors-origin",
        type=web_origin,
        action="append",
        default=[],
        metavar="ORIGIN",
        help="let pages of this origin, e.g. https://maps.example.com, call from browsers; may be given several times",
    )
    serve.add_argument(
        "--allowed-host",
        action="append",
        default=[],
        metavar="NAME",
        help="another host name under which a service without keys answers, e.g. that of a proxy before it; "
        "may be given several times",
    )
    serve.add_argument(
        "--root-path",
        type=web_prefix,
        metavar="PATH",
        help="path prefix under which a proxy serves the service, e.g. /rayfix; the proxy may strip it or not",
    )
    serve.add_argument(
        "--trust-forwarded-prefix",
        action="store_true",
        help="take that prefix from the header X-Forwarded-Prefix; only safe if all requests come through the proxy",
    )
    serve.add_argument(
        "--check-seconds",
        type=positive,
        default=10.0,
        metavar="S",
        help="processor time for the check of a table, in addition to 60 s per GB (default: 10)",
    )
    serve.add_argument(
        "--check-memory-mb",
        type=positive,
        default=256.0,
        metavar="MB",
        help="memory for the check of a table, in addition to three times its size (default: 256)",
    )
    add_service_broker_arguments(serve)
    _add_limit_arguments(serve)
    _add_message_arguments(serve)

    api_key = add("api-key", _api_key, "make an API key, print it once, and add its hash to a key file")
    api_key.add_argument("name", metavar="NAME", help="name of the key's owner")
    api_key.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="key file, created if necessary"
    )


def _add_limit_arguments(command: argparse.ArgumentParser) -> None:
    """Add the limits on connections; their defaults are those of the service's settings."""
    limits = command.add_argument_group("limits on connections, for each worker")
    for name, default, text in (
        ("connections", 1000, "open connections"),
        ("head-kib", 32, "longest head of a request, KiB"),
        ("head-fields", 100, "most header fields of a request"),
        ("listeners", 100, "listeners of GET /v1/fixes"),
        ("backlog-kib", 2048, "fixes that wait for one listener, KiB"),
    ):
        limits.add_argument(
            f"--{name}", type=at_least_one, default=default, metavar="N", help=f"{text} (default: {default})"
        )
    for name, seconds, text in (
        ("head-seconds", 10.0, "time for the head of a request"),
        ("body-seconds", 60.0, "time for the body of a request"),
        ("idle-seconds", 5.0, "time between two requests of a connection"),
        ("unread-seconds", 30.0, "time that a client may leave an answer unread"),
    ):
        limits.add_argument(
            f"--{name}", type=positive, default=seconds, metavar="S", help=f"{text} (default: {seconds:g})"
        )


_MESSAGES = (
    ("report-values", 5000, "values of a report"),
    ("message-values", 50_000, "values of a message of another format"),
    ("message-results", 1024, "measurements of an NRPPa message"),
    ("message-stations", 1024, "names in a message's map of stations"),
    ("batch-rest-kib", 64, "content of a batch besides its reports, KiB"),
    ("listed-errors", 50, "offending fields that a problem lists"),
    ("body-kib", 1024, "longest body of a request, KiB"),
    ("batch-kib", 16384, "longest body of a batch, KiB"),
)


def _add_message_arguments(command: argparse.ArgumentParser) -> None:
    """Add the limits on messages; their defaults are those of the service's settings."""
    limits = command.add_argument_group("limits on messages")
    for name, default, text in _MESSAGES:
        limits.add_argument(
            f"--{name}", type=at_least_one, default=default, metavar="N", help=f"{text} (default: {default})"
        )


def _serve(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix_service.process_wide import collector_paused

        with collector_paused():  # what is imported stays
            from rayfix_service.http.settings import BodyLimits, ConnectionLimits, FeedLimits, ServiceSettings
            from rayfix_service.server.server import is_loopback, serve
            from rayfix_service.wire.limits import MessageLimits
    from rayfix_tables.checked import CheckLimits

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
            hosts=tuple(options.allowed_host),
            root_path=options.root_path or "",
            trust_forwarded_prefix=options.trust_forwarded_prefix,
            body_limits=BodyLimits(report=options.body_kib << 10, batch=options.batch_kib << 10),
            message_limits=MessageLimits(
                report_values=options.report_values,
                message_values=options.message_values,
                results=options.message_results,
                stations=options.message_stations,
                batch_rest_bytes=options.batch_rest_kib << 10,
                listed_problems=options.listed_errors,
            ),
            connection_limits=ConnectionLimits(
                connections=options.connections,
                head_bytes=options.head_kib << 10,
                head_fields=options.head_fields,
                head_seconds=options.head_seconds,
                body_seconds=options.body_seconds,
                idle_seconds=options.idle_seconds,
                unread_seconds=options.unread_seconds,
            ),
            feed_limits=FeedLimits(listeners=options.listeners, backlog_bytes=options.backlog_kib << 10),
            track=options.track,
            hub=hub_settings(options),
            mqtt=mqtt_source(options),
            table_check=CheckLimits(seconds=options.check_seconds, memory=round(options.check_memory_mb * 1e6)),
            simulation=options.allow_simulation or is_loopback(options.host),
        ),
    )
    return 0


def _api_key(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix_service.http.access.keys import add_key
    print(add_key(options.output, options.name))
    return 0
