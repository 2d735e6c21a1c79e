"""Serve a table over HTTP."""

import os
import socket
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import uvicorn
from fastapi import FastAPI

from rayfix_service.http.app import create_app
from rayfix_service.http.logs import LogFormat, log_config
from rayfix_service.http.metrics import MULTIPROCESS_VARIABLE
from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table

TABLE_VARIABLE = "RAYFIX_TABLE"
"""Environment variable that tells worker processes the table's path."""

_MAX_MESSAGE = 16 << 20  # bytes; up to here a message that is too long is answered, beyond it ends the connection
_SHUTDOWN_SECONDS = 10  # for requests under way; a full batch takes about one


class ServiceError(RayfixError):
    """The service cannot start."""


def serve(
    table_path: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    workers: int = 1,
    log_format: LogFormat = "text",
    access_log: bool = False,
) -> None:
    """Serve a table until the process is told to end (SIGINT, SIGTERM); requests under way are finished.

    Parameters
    ----------
    table_path : str or pathlib.Path
        The table.
    host : str
        Name or address to listen on; ``0.0.0.0`` is every IPv4 interface.
    port : int
        TCP port; 0 takes a free one, which the log names.
    workers : int
        Processes that share the port and, since they map it, the memory of the table.
    log_format : {"text", "json"}
        JSON is an object a line.
    access_log : bool
        Whether to log a line per request. It costs more than it tells, with a hundred targets at 5 Hz.

    Raises
    ------
    TableError
        When the table is missing, of another format, or damaged.
    ServiceError
        When the port is taken, or an argument is out of range.
    """
    path = Path(table_path).absolute()
    if workers < 1:
        raise ServiceError(f"workers is {workers}; give at least 1")
    Table.open(path).verify()
    check_address(host, port)
    with ExitStack() as stack:
        app: str | FastAPI = f"{__name__}:{app_from_environment.__name__}"
        if workers > 1:
            os.environ[TABLE_VARIABLE] = str(path)
            if MULTIPROCESS_VARIABLE not in os.environ:
                # Where the workers share their figures; whichever is asked answers for all.
                os.environ[MULTIPROCESS_VARIABLE] = stack.enter_context(TemporaryDirectory(prefix="rayfix-metrics-"))
                stack.callback(os.environ.pop, MULTIPROCESS_VARIABLE)
        else:
            app = create_app(path)
        uvicorn.run(
            app,
            factory=workers > 1,
            host=host,
            port=port,
            workers=workers,
            ws_max_size=_MAX_MESSAGE,
            ws_per_message_deflate=False,  # costs more than it saves, on messages of a kilobyte
            timeout_graceful_shutdown=_SHUTDOWN_SECONDS,
            access_log=False,  # this package has one of its own
            log_config=log_config(log_format, access_log=access_log),
        )


def app_from_environment() -> FastAPI:
    """Make the application in a worker process, from the table that the environment names.

    Raises
    ------
    ServiceError
        When it names none.
    """
    path = os.environ.get(TABLE_VARIABLE)
    if not path:
        raise ServiceError(f"the environment variable {TABLE_VARIABLE} is not set; set it to a table's path")
    return create_app(Path(path))


def check_address(host: str, port: int) -> None:
    """Check that a server can listen there.

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
        raise ServiceError(f"host {host!r} is no address of this machine; try 127.0.0.1 or 0.0.0.0") from None
    with socket.socket(family, kind, protocol) as probe:
        # As the server will do: a port that merely cools down after its last server is free.
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
