"""``rayfix demo``: builds, serves and locates in the bundled hall."""

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from rayfix.console import counted, place, print_build_summary
from rayfix.example.drop import EXAMPLE_POSITION, example_paths, report_text, simulate_example_report
from rayfix.example.files import REPORT_FILE, write_example
from rayfix.own_command import own_command
from rayfix.progress import build_progress
from rayfix_evaluation.pictures.plot import plot_fix
from rayfix_offline.build import build_table
from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table

_IDLE_SECONDS = 120.0
"""A service that is not ready counts as hung after this time without processor use or log output."""

_ANSWER_SECONDS = 600.0

_LOG_HEAD = re.compile(r"^(\S+Z )?[A-Z]+: *")
"""Time and severity at the beginning of a line of the service's log."""


def run_demo(folder: Path, *, jobs: int = -1) -> float:
    """Build the hall's table, serve it, post a report, and print and draw the fix.

    Parameters
    ----------
    folder : Path
        Folder of all output files.

    Returns
    -------
    float
        Error of the position, m.

    Raises
    ------
    RayfixError
        When a step fails.
    """
    begin = time.perf_counter()
    print("1. The bundled hall, 8 x 18 x 2.5 m, four stations in its top corners, becomes a table.")
    site = write_example(folder)
    table_path = folder / "hall.h5"
    with build_progress(enabled=True) as progress:
        summary = build_table(site, table_path, jobs=jobs, progress=progress)
    print_build_summary(summary)

    print("\n2. A UE behind machines transmits; each station reports the angle (1 deg) and time (0.5 m) of one path.")
    paths = example_paths()
    report = json.loads(report_text(simulate_example_report(paths)))
    (folder / REPORT_FILE).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    for station_id, found in paths.items():
        bounces = int(found.num_reflections[0])
        print(f"   {station_id}: " + ("direct path" if bounces == 0 else f"path with {counted(bounces, 'reflection')}"))

    print("\n3. The service locates the report.")
    with _service(table_path) as url:
        try:
            answer = httpx.post(f"{url}/v1/positions", json=report, timeout=_ANSWER_SECONDS, trust_env=False)
        except httpx.TransportError as failure:
            raise RayfixError(f"the service gave no answer ({failure}); its log is {_log_of(table_path)}") from failure
    if answer.status_code != httpx.codes.OK:
        raise RayfixError(f"the service answered {answer.status_code}: {answer.text}")
    document = answer.json()
    error = _print_outcome(document)

    picture = folder / "fix.png"
    rays = {name: found.vertices[0] for name, found in paths.items()}
    plot_fix(picture, Table.open(table_path), document, truth=EXAMPLE_POSITION, rays=rays)
    print(f"\nThe picture is {picture}. The demo took {time.perf_counter() - begin:.0f} s.")
    print(f"Serve this table yourself: {own_command()} serve {table_path}")
    return error


def _print_outcome(document: dict[str, Any]) -> float:
    if document["position"] is None:
        raise RayfixError(f"the service found no position: status {document['status']}")
    position = np.array([document["position"][axis] for axis in "xyz"])
    error = float(np.linalg.norm(position - EXAMPLE_POSITION))
    values, vectors = np.linalg.eigh(np.array(document["covariance_m2"]))
    print(f"   truth     {place(dict(zip('xyz', EXAMPLE_POSITION, strict=True)))}")
    print(f"   estimate  {place(document['position'])}, status {document['status']}")
    print(f"   error     {error:.2f} m")
    print("   ellipsoid, one standard deviation along its axes:")
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        print(f"             {np.sqrt(value):.2f} m along ({vector[0]:+.2f}, {vector[1]:+.2f}, {vector[2]:+.2f})")
    rivals = document["candidates"][1:]
    print(f"   rivals    {len(rivals) or 'none'}")
    for rival in rivals:
        print(f"             {place(rival['position'])} with a probability of {rival['probability']:.1%}")
    print(f"   computed in {document['compute_ms']:.1f} ms")
    return error


@contextmanager
def _service(table_path: Path) -> Iterator[str]:
    """Serve a table in a separate process until the block ends."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    log = _log_of(table_path)
    with log.open("wb") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "rayfix", "serve", str(table_path), "--port", str(port)],
            stdout=sink,
            stderr=subprocess.STDOUT,
        )
        try:
            _wait_until_ready(url, process, log)
            yield url
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _log_of(table_path: Path) -> Path:
    return table_path.with_name("service.log")


def _wait_until_ready(url: str, process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait for readiness as long as the service runs and makes progress, and show its log messages."""
    shown = 0
    trace, since = _trace(process.pid, log), time.monotonic()
    while process.poll() is None:
        try:
            if httpx.get(f"{url}/readyz", timeout=2.0, trust_env=False).status_code == httpx.codes.OK:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
        shown = _show_kernels(log, shown)
        if (now := _trace(process.pid, log)) != trace:
            trace, since = now, time.monotonic()
        elif time.monotonic() - since > _IDLE_SECONDS:
            raise RayfixError(f"the service has done nothing for {_IDLE_SECONDS:.0f} s; its log is {log}")
    raise RayfixError(f"the service ended with status {process.returncode}; see its log {log}{_last_line(log)}")


def _trace(pid: int, log: Path) -> tuple[str, int]:
    """Return two measures of progress: the process's processor time and the size of its log."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:  # the process has just ended
        fields = []
    return " ".join(fields[11:15]), log.stat().st_size


def _show_kernels(log: Path, shown: int) -> int:
    """Print the complete lines about kernels after a position in the log; returns the position after them."""
    with log.open("rb") as file:
        file.seek(shown)
        new = file.read()
    whole = new[: new.rfind(b"\n") + 1]
    for line in whole.decode("utf-8", "replace").splitlines():
        if "kernels" in line:
            print(f"   {_LOG_HEAD.sub('', line)}", flush=True)
    return shown + len(whole)


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f": {lines[-1]}" if lines else ""
