"""A service in a separate process that a benchmark loads, monitors and kills."""

import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx


def _nothing() -> None:
    """Do nothing while a service starts."""


class RunningService:
    """``rayfix serve`` on a free loopback port.

    Parameters
    ----------
    command : list of str
        Arguments of the Python interpreter.

    The waits are long enough for the kernels to be compiled.

    Attributes
    ----------
    process : subprocess.Popen
    url : str
    """

    def __init__(self, command: list[str]) -> None:
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", *command], stdout=self._log, stderr=self._log
        )
        self.url = ""

    @property
    def port(self) -> int:
        """Port, once it listens."""
        return int(self.url.rpartition(":")[2])

    def log(self) -> str:
        """Return what it has printed."""
        self._log.seek(0)
        return self._log.read()

    def wait_until_listening(self, seconds: float = 600.0, *, meanwhile: Callable[[], None] = _nothing) -> None:
        """Wait until it has printed its address, and call ``meanwhile`` often.

        Raises
        ------
        RuntimeError
            When it ends or takes too long.
        """
        deadline = time.monotonic() + seconds
        while not (found := re.search(r"running on (http://127\.0\.0\.1:\d+)", self.log())):
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the service does not listen:\n{self.log()}")
            meanwhile()
            time.sleep(0.02)
        self.url = found[1]

    def wait_until_ready(self, seconds: float = 600.0, *, meanwhile: Callable[[], None] = _nothing) -> None:
        """Wait until it can locate, and call ``meanwhile`` often.

        Raises
        ------
        RuntimeError
            When it ends or takes too long.
        """
        self.wait_until_listening(seconds, meanwhile=meanwhile)
        deadline = time.monotonic() + seconds
        while not answers(f"{self.url}/readyz"):
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the service does not become ready:\n{self.log()}")
            meanwhile()
            time.sleep(0.02)

    def close(self) -> None:
        """End it, by force where it does not end by itself."""
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(30)
        self._log.close()


def answers(url: str, *, seconds: float = 5.0) -> bool:
    """Tell whether a GET is answered with 200."""
    try:
        return httpx.get(url, trust_env=False, timeout=seconds).status_code == 200
    except httpx.TransportError:
        return False


def serve_command(tables: Path, *arguments: str) -> list[str]:
    """Arguments of the Python interpreter for ``rayfix serve`` on a free port."""
    return ["-m", "rayfix", "serve", str(tables), "--port", "0", *arguments]


@contextmanager
def running(command: list[str]) -> Iterator[RunningService]:
    """Run a service until the context ends; it begins once the service can locate."""
    service = RunningService(command)
    try:
        service.wait_until_ready()
        yield service
    finally:
        service.close()


def resident_mebibytes(pid: int) -> float:
    """Memory that a process holds, MiB."""
    return int(re.findall(r"^VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)[0]) / 1024


def open_files(pid: int) -> int:
    """File descriptors that a process has open."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))
