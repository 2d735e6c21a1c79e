"""A real server, for the tests that need one."""

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

_CODE = """\
import json, sys
from pydantic import TypeAdapter
from rayfix_service.http.server import serve
from rayfix_service.http.settings import ServiceSettings
options = json.loads(sys.argv[2])
settings = TypeAdapter(ServiceSettings).validate_python(options.pop("settings", {}))
serve(sys.argv[1], settings=settings, **options)
"""


class ServerProcess:
    """A server in a process of its own, on a free loopback port; as a context, one that is ready."""

    def __init__(self, tables: Path, **options: object) -> None:
        arguments = [str(tables), json.dumps({"port": 0, **options})]
        self.process = subprocess.Popen([sys.executable, "-c", _CODE, *arguments], stderr=subprocess.PIPE, text=True)
        self.workers = options.get("workers", 1)
        self.log: list[str] = []
        self._listening = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> "ServerProcess":
        """Wait until all workers can locate."""
        try:
            self.wait_for("ready with", self.workers)
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
    def port(self) -> int:
        """Port, once it listens."""
        assert self._listening.wait(60), "".join(self.log)
        (line,) = (line for line in self.log if "running on http://" in line)
        return int(re.findall(r"http://127\.0\.0\.1:(\d+)", line)[0])

    def client(self) -> httpx.Client:
        """Return a client with connections of its own."""
        return httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=30, trust_env=False)

    def wait_for(self, text: str, times: int = 1, seconds: float = 100.0) -> None:
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


@pytest.fixture(scope="session")
def start_server() -> Callable[..., ServerProcess]:
    """Return what starts a server: of a table, with arguments of ``serve``. Use it as a context or stop it."""
    return ServerProcess
