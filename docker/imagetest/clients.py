"""Clients of a service: one report, many at a time, and what became of them."""

import http.client
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


def post(port: int, path: str, body: bytes, headers: dict[str, str], timeout: float = 60.0) -> tuple[int, Any]:
    """Post JSON on a connection of its own; returns status and document."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout)
    try:
        connection.request("POST", path, body, {"content-type": "application/json", "connection": "close", **headers})
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        connection.close()


def get(port: int, path: str) -> tuple[int, bytes]:
    """Get a path; the status is 0 while nobody listens."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5.0)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.read()
    except OSError:
        return 0, b""
    finally:
        connection.close()


@dataclass
class Load:
    """Requests sent and what became of them."""

    answered: int = 0
    answered_after: int = 0
    """Requests that were sent before the service was told to end, and answered after."""
    turned_away: int = 0
    """Requests that were sent whole only after that, and refused, or reset for want of a server."""
    failed: list[str] = field(default_factory=list)
    ending: float = float("inf")
    """When the service was told to end."""

    _lock: threading.Lock = field(default_factory=threading.Lock)

    def send(self, port: int, path: str, body: bytes, headers: dict[str, str]) -> bool:
        """Send one; returns whether the service still took it."""
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
        try:
            connection.connect()
        except OSError:
            with self._lock:
                self.turned_away += 1
            return False
        sent = float("inf")
        try:
            headers = {"content-type": "application/json", "connection": "close", **headers}
            connection.request("POST", path, body, headers)
            sent = time.monotonic()
            answer = connection.getresponse()
            answer.read()
            with self._lock:
                if answer.status == 200:
                    self.answered += 1
                    self.answered_after += sent < self.ending < time.monotonic()
                else:
                    self.failed.append(f"{path}: status {answer.status}")
        except (OSError, http.client.HTTPException) as error:
            with self._lock:
                if sent < self.ending:
                    self.failed.append(f"{path}: {error!r}")
                else:
                    self.turned_away += 1
        finally:
            connection.close()
        return True


@contextmanager
def loaded(port: int, bodies: dict[str, bytes], headers: dict[str, str], clients: int) -> Iterator[Load]:
    """Send requests to paths, each client one after the other until nobody takes them."""
    load = Load()

    def client(path: str, body: bytes) -> None:
        while load.send(port, path, body, headers):
            pass

    threads = [
        threading.Thread(target=client, args=item, daemon=True) for item in bodies.items() for _ in range(clients)
    ]
    for thread in threads:
        thread.start()
    try:
        yield load
    finally:
        for thread in threads:
            thread.join(60)
