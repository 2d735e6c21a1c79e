"""A server in a process of its own."""

import json
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx

_SERVE = """\
import json, sys
from pydantic import TypeAdapter
from rayfix_service.server.server import serve
from rayfix_service.http.settings import ServiceSettings
options = json.loads(sys.argv[2])
settings = TypeAdapter(ServiceSettings).validate_python(options.pop("settings", {}))
serve(sys.argv[1], settings=settings, **options)
"""


class ServerProcess:
    """A server on a free loopback port; as a context, one of which all workers can locate.

    Parameters
    ----------
    *arguments
        Of the Python interpreter.
    workers : int
        Processes that will answer.

    Attributes
    ----------
    process : subprocess.Popen
    log : list of str
        Lines so far.
    """

    def __init__(self, *arguments: str | Path, workers: int = 1) -> None:
        self.process = subprocess.Popen([sys.executable, *arguments], stderr=subprocess.PIPE, text=True)
        self.log: list[str] = []
        self._workers = workers
        self._listening = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> "ServerProcess":
        """Wait until all workers can locate."""
        try:
            self.wait_for("ready with", self._workers)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        """End it."""
        self.stop()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.log.append(line)
            if "running on http://" in line:
                self._listening.set()

    @property
    def url(self) -> str:
        """Address, once it listens."""
        assert self._listening.wait(600), "".join(self.log)
        (address,) = re.findall(r"running on (http://127\.0\.0\.1:\d+)", "".join(self.log))
        return str(address)

    @property
    def port(self) -> int:
        """Port, once it listens."""
        return int(self.url.rpartition(":")[2])

    def client(self) -> httpx.Client:
        """Return a client with connections of its own."""
        return httpx.Client(base_url=self.url, timeout=30, trust_env=False)

    def wait_for(self, text: str, times: int = 1, seconds: float = 600.0) -> None:
        """Wait until the log has had a text so many times."""
        deadline = time.monotonic() + seconds
        while sum(text in line for line in list(self.log)) < times:
            assert self.process.poll() is None, "".join(self.log)
            assert time.monotonic() < deadline, "".join(self.log)
            time.sleep(0.02)

    def stop(self) -> str:
        """Ask the server to end, if it runs, and return its log."""
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(30)
        finally:
            self.process.kill()
            self._reader.join(10)
            assert self.process.stderr is not None
            self.process.stderr.close()
        return "".join(self.log)


def start_server(tables: Path, *, workers: int = 1, **options: object) -> ServerProcess:
    """Start ``rayfix_service.server.server.serve``, without the face, with other arguments of it."""
    text = json.dumps({"port": 0, "workers": workers, **options})
    return ServerProcess("-c", _SERVE, tables, text, workers=workers)


def start_rayfix_serve(tables: Path, *arguments: str | Path) -> ServerProcess:
    """Start the command ``rayfix serve`` with one worker."""
    return ServerProcess("-m", "rayfix", "serve", tables, *arguments, "--port", "0")
