"""``rayfix demo``: the whole main job on the bundled hall, for real and in a minute or two."""

import json
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

from rayfix.console import build_progress, counted, place, print_build_summary
from rayfix.example.drop import EXAMPLE_POSITION, example_paths, report_text, simulate_example_report
from rayfix.example.files import REPORT_FILE, write_example
from rayfix_evaluation.pictures.plot import plot_fix
from rayfix_offline.build import build_table
from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table

_READY_SECONDS = 120.0


def run_demo(folder: Path, *, jobs: int = -1) -> float:
    """Build the hall's table, serve it, post a report, and print and draw the fix.

    Parameters
    ----------
    folder : Path
        Where everything goes.

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

    print("\n2. A UE behind machines sends; each station reports the angle (1 deg) and time (0.5 m) of one path.")
    paths = example_paths()
    report = json.loads(report_text(simulate_example_report(paths)))
    (folder / REPORT_FILE).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    for station_id, found in paths.items():
        bounces = int(found.num_reflections[0])
        print(f"   {station_id} hears it " + ("directly" if bounces == 0 else f"by {counted(bounces, 'reflection')}"))

    print("\n3. The service takes the report.")
    with _service(table_path) as url:
        answer = httpx.post(f"{url}/v1/positions", json=report, timeout=30.0, trust_env=False)
    if answer.status_code != httpx.codes.OK:
        raise RayfixError(f"the service answered {answer.status_code}: {answer.text}")
    document = answer.json()
    error = _print_outcome(document)

    picture = folder / "fix.png"
    rays = {name: found.vertices[0] for name, found in paths.items()}
    plot_fix(picture, Table.open(table_path), document, truth=EXAMPLE_POSITION, rays=rays)
    print(f"\nThe picture is {picture}. All this took {time.perf_counter() - begin:.0f} s.")
    print(f"Serve this table yourself: rayfix serve {table_path}")
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
    """Serve a table in a process of its own until the block ends."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    log = table_path.with_name("service.log")
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


def _wait_until_ready(url: str, process: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + _READY_SECONDS
    while time.monotonic() < end:
        if process.poll() is not None:
            break
        try:
            if httpx.get(f"{url}/readyz", timeout=2.0, trust_env=False).status_code == httpx.codes.OK:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise RayfixError(f"the service did not start; its last words are in {log}")
