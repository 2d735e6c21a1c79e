"""A log of a target that walks through the example hall, and where it was."""

import json
from pathlib import Path

import numpy as np

from rayfix.example.drop import EXAMPLE_NOISE
from rayfix.example.hall import hall_scene, hall_stations
from rayfix_evaluation.drops.simulate import simulate_report
from rayfix_evaluation.truth.forward import ForwardSolver

_BEGIN, _END = np.array([4.5, 9.0, 1.0]), np.array([5.5, 15.0, 1.0])


def write_walk(log: Path, truth: Path, *, num_reports: int, seconds: float = 0.5) -> None:
    """Write the reports of a walk and its true places, a report each ``seconds``."""
    mesh = hall_scene().to_geometry()
    solver = ForwardSolver.from_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    rng = np.random.default_rng(3)
    reports, places = [], ["target_id,timestamp,x_m,y_m,z_m"]
    for n, share in enumerate(np.linspace(0.0, 1.0, num_reports)):
        at = _BEGIN + share * (_END - _BEGIN) + [0.4 * np.sin(np.pi * share), 0.0, 0.0]
        time = f"2026-01-31T10:00:{seconds * n:06.3f}Z"
        paths = {name: solver.paths(np.array(position), at) for name, position in hall_stations()}
        report = simulate_report(paths, EXAMPLE_NOISE, rng=rng, timing="pt", target_id="agv-7")
        reports.append(json.dumps({**report, "timestamp": time}))
        places.append(",".join(["agv-7", time, *(f"{value:.3f}" for value in at)]))
    log.write_text("\n".join(reports) + "\n", encoding="utf-8")
    truth.write_text("\n".join(places) + "\n", encoding="utf-8")
