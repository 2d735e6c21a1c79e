"""A real service for the clients."""

import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest


@pytest.fixture(scope="session")
def service_url(hall_table_path: Path) -> Iterator[str]:
    """Address of a service in a process of its own, ready to locate."""
    command = [sys.executable, "-m", "rayfix", "serve", str(hall_table_path), "--port", "0"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    log = []
    try:
        url = ready = ""
        for line in process.stderr:
            log.append(line)
            found = re.search(r"http://127\.0\.0\.1:\d+", line)
            url = found[0] if found else url
            ready = line if "ready with" in line else ready
            if url and ready:
                break
        assert url, "".join(log)
        reader = threading.Thread(target=process.stderr.read, daemon=True)  # so that its log never blocks it
        reader.start()
        assert httpx.get(f"{url}/readyz", trust_env=False).status_code == 200
        yield url
    finally:
        process.terminate()
        process.wait(30)
        reader.join(10)
        process.stderr.close()
