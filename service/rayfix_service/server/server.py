"""Serve tables over HTTP."""

import asyncio
import gc
import ipaddress
import logging
import os
import resource
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import cast

import uvicorn

from rayfix_service.http.access.keys import read_key_file
from rayfix_service.http.access.rates import Accounts
from rayfix_service.http.answering.freed_memory import one_arena
from rayfix_service.http.answering.runtime_folder import runtime_folder
from rayfix_service.http.answering.served_tables import ServedTable, follow_changes, load_tables
from rayfix_service.http.answering.table_checks import TableChecks
from rayfix_service.http.errors import ServiceError
from rayfix_service.http.settings import ConnectionLimits, ServiceSettings
from rayfix_service.http.telemetry.connections import Crowd
from rayfix_service.http.telemetry.logs import LogFormat, log_config
from rayfix_service.http.telemetry.metrics import MULTIPROCESS_VARIABLE, share_figures
from rayfix_service.process_wide import collector_paused, logging_restored
from rayfix_service.server.app import create_app
from rayfix_service.server.protocol import GatheringProtocol, SocketProtocol
from rayfix_service.server.workers import COULD_NOT_START, run_workers, tell_failure, tell_started
from rayfix_service.web.assets import viewer_is_built
from rayfix_tables.errors import RayfixError

_MESSAGES = 2  # times as long as a report may be, a message is answered that it is too long; then the connection ends
_FIGURES_BYTES = 8 << 20  # for the metrics of some workers
_OTHER_FILES = 150  # that a worker may have open besides its connections: tables, libraries, pipes, a few spare ones
_SHUTDOWN_SECONDS = 10  # for requests in progress; a full batch takes about one
_ARRIVING_SECONDS = 0.2  # for requests that are still arriving at shutdown

_TRACKS = (
    "track is set with {} workers, among which a target's reports would be split; follow targets with one worker, or "
    "with one on each of several ports, balanced by target_id (docs/tracking.md)"
)

_NO_VIEWER = "this installation has no viewer; / explains how to get it, and /docs is a page without scripts"

_FEW_FILES = (
    "a worker accepts %d connections instead of %d, because it may not open more files; raise its limit (ulimit -n) "
    "or give fewer --connections"
)

_log = logging.getLogger(__name__)


def serve(
    tables_path: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    workers: int = 1,
    log_format: LogFormat = "text",
    access_log: bool = False,
    settings: ServiceSettings | None = None,
) -> None:
    """Serve tables until the process receives SIGINT or SIGTERM; requests in progress are finished.

    Parameters
    ----------
    tables_path : str or pathlib.Path
        A table, or a folder of tables ``*.h5``.
    host : str
        Name or address to listen on; ``0.0.0.0`` is every IPv4 interface.
    port : int
        TCP port; 0 chooses a free one and logs it.
    workers : int
        Processes that listen on the same port. They are forked after the tables are loaded and share most of their
        memory.
    log_format : {"text", "json"}
        JSON has one object per line.
    access_log : bool
        Whether to log one line per request; a hundred targets at 5 Hz make 500 lines per second.
    settings : ServiceSettings, optional

    Raises
    ------
    TableError
        When no table can be used: missing, of another format, or damaged. If some can be used, these are served.
    ServiceError
        When no worker can start, the port is taken, an argument is out of range, the keys are missing, the folder for
        figures cannot be written to, or several workers are to follow targets.
    BrokerError, ReportError
        When the settings of the MQTT broker cannot be used with the table.
    """
    path = Path(tables_path).absolute()
    settings = replace(settings or ServiceSettings(), own_process=True)
    if workers < 1:
        raise ServiceError(f"workers is {workers}; give at least 1")
    if workers > 1 and settings.track:
        raise ServiceError(_TRACKS.format(workers))
    if settings.api_keys is not None:
        read_key_file(settings.api_keys)
    elif not is_loopback(host):
        raise ServiceError(
            f"host {host} can be reached from other machines, so that API keys are needed; make one with "
            "'rayfix api-key NAME -o FILE' and give --api-keys FILE, or listen on 127.0.0.1"
        )
    else:
        settings = replace(settings, hosts=(*settings.hosts, host))
    check_address(host, port)
    with ExitStack() as stack:
        stack.enter_context(logging_restored())
        stack.enter_context(one_arena())
        if workers > 1:
            settings = replace(settings, runtime_folder=stack.enter_context(_runtime_folder()))
        if MULTIPROCESS_VARIABLE in os.environ:
            _check_room(Path(os.environ[MULTIPROCESS_VARIABLE]))
        checks = TableChecks(settings.runtime_folder, settings.table_check)
        at_hand: dict[str, ServedTable] = {}
        limits = fitting(settings.connection_limits)
        config = uvicorn.Config(
            partial(create_app, path, settings, at_hand=at_hand, accounts=Accounts()),
            factory=True,
            host=host,
            port=port,
            http=cast("type[asyncio.Protocol]", partial(GatheringProtocol, crowd=Crowd(limits))),
            ws=SocketProtocol,
            ws_max_size=_MESSAGES * settings.body_limits.report,
            timeout_keep_alive=cast("int", limits.idle_seconds),
            ws_per_message_deflate=False,  # costs more than it saves for messages of a kilobyte
            timeout_graceful_shutdown=_SHUTDOWN_SECONDS,
            server_header=False,
            access_log=False,  # this package has its own
            log_config=log_config(log_format, access_log=access_log),
        )
        if limits != settings.connection_limits:
            _log.warning(_FEW_FILES, limits.connections, settings.connection_limits.connections)
        with collector_paused():
            at_hand.update(load_tables(path, checks=checks))  # after logging is configured: compiling logs messages
        if not viewer_is_built():
            _log.warning(_NO_VIEWER)
        if settings.mqtt is not None:
            # Imported here, since it needs an extra that a service without a broker may lack.
            from rayfix_service.http.answering.mqtt_listener import check_source

            check_source(settings.mqtt, at_hand)
        gc.collect()  # while nobody waits for an answer
        gc.freeze()  # a collection would write to the workers' shared memory and thus copy it
        stack.callback(gc.unfreeze)
        stack.callback(gc.set_threshold, *gc.get_threshold())  # the app changes it
        if workers == 1:
            with suppress(KeyboardInterrupt):
                _run(config)
            return
        with config.bind_socket() as bound:
            run_workers(
                partial(_work, config, bound),
                count=workers,
                meanwhile=partial(follow_changes, at_hand, path, checks, failed=set()),
                ending=bound.close,  # otherwise the system would accept connections that no process answers
            )


def fitting(limits: ConnectionLimits) -> ConnectionLimits:
    """Raise the limit of open files to what the connections need, and return the limits that are possible.

    A process at the limit cannot accept connections; these wait without an answer.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = limits.connections + _OTHER_FILES
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return limits
    allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
        soft = allowed
    return limits if soft >= needed else replace(limits, connections=max(soft - _OTHER_FILES, 1))


def _work(config: uvicorn.Config, bound: socket.socket) -> None:
    """Run one of several processes that serve an address."""
    share_figures()
    try:
        _run(config, bound)
    except RayfixError as error:
        tell_failure(str(error))
        sys.exit(COULD_NOT_START)


def _run(config: uvicorn.Config, *bound: socket.socket) -> None:
    """Answer requests until shutdown."""
    server = _Server(config)
    server.run(list(bound) or None)
    if not server.started:
        raise ServiceError("the service could not start; the log has the cause")


class _Server(uvicorn.Server):
    """A server that still answers requests that were sent before the signal to end.

    Such a request may wait in a connection that is not yet accepted or read, which uvicorn would close.
    """

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen."""
        await super().startup(sockets)
        if self.started:
            tell_started()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept requests that have arrived, then stop listening and finish requests in progress."""
        await asyncio.sleep(_ARRIVING_SECONDS)
        await super().shutdown(sockets)


@contextmanager
def _runtime_folder() -> Iterator[Path]:
    """Create the workers' shared folder, with a folder for their metrics unless the environment names one."""
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(runtime_folder())
        except OSError as error:
            raise ServiceError(
                f"the workers need a temporary folder and there is none ({error.strerror}); set TMPDIR to one"
            ) from None
        if MULTIPROCESS_VARIABLE not in os.environ:
            # Any worker reports the metrics of all.
            (folder / "metrics").mkdir()
            os.environ[MULTIPROCESS_VARIABLE] = str(folder / "metrics")
            stack.callback(os.environ.pop, MULTIPROCESS_VARIABLE)
        yield folder


def _check_room(folder: Path) -> None:
    """Check that workers can write their metrics.

    They map sparse files there: on a full disk, the first page without space ends the process with a signal.
    """
    try:
        with NamedTemporaryFile(dir=folder, prefix="rayfix-") as file:
            os.posix_fallocate(file.fileno(), 0, _FIGURES_BYTES)
    except OSError as error:
        raise ServiceError(
            f"{MULTIPROCESS_VARIABLE} is {folder}, where metrics cannot be written ({error.strerror}); "
            "make room there or give another folder"
        ) from None


def check_address(host: str, port: int) -> None:
    """Check that a server can listen on a host and port.

    Raises
    ------
    ServiceError
        When it cannot.
    """
    if not 0 <= port <= 65535:
        raise ServiceError(f"port is {port}; give one from 0 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError):
        raise ServiceError(f"host {host!r} is not an address of this machine; try 127.0.0.1 or 0.0.0.0") from None
    with socket.socket(family, kind, protocol) as probe:
        # As the server does: a port in TIME_WAIT after an earlier server counts as free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
            probe.listen()
        except PermissionError:
            raise ServiceError(f"port {port} needs administrator rights; give one from 1024 on") from None
        except OSError as error:
            raise ServiceError(
                f"cannot listen on {host} port {port} ({error.strerror}); end what uses it or give another"
            ) from None


def is_loopback(host: str) -> bool:
    """Whether a host's address can be reached from this machine only."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return False
    return all(ipaddress.ip_address(str(address[0]).partition("%")[0]).is_loopback for *_, address in found)
