"""A UE in the bundled hall with line of sight to one station and reflected paths to three: its position and report."""

import json
from typing import Any

import numpy as np

from rayfix.example.hall import hall_scene, hall_stations
from rayfix_evaluation.drops.simulate import Noise, simulate_report
from rayfix_evaluation.truth.forward import ForwardSolver, Paths

EXAMPLE_POSITION = (5.32, 14.2, 0.67)
"""Position of the UE, m."""

EXAMPLE_NOISE = Noise(azimuth_stdev=np.deg2rad(1.0), zenith_stdev=np.deg2rad(1.0), range_stdev=0.5)
"""Noise of the report: 1 deg and 0.5 m."""


def example_paths() -> dict[str, Paths]:
    """Paths from each station to the UE, by the image method."""
    mesh = hall_scene().to_geometry()
    solver = ForwardSolver.from_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return {name: solver.paths(np.array(position), np.array(EXAMPLE_POSITION)) for name, position in hall_stations()}


def simulate_example_report(paths: dict[str, Paths], *, seed: int = 1) -> dict[str, Any]:
    """Report of the strongest path to each station, with noise; seed 1 gives the bundled report."""
    return simulate_report(
        paths,
        EXAMPLE_NOISE,
        rng=np.random.default_rng(seed),
        timing="pt",
        target_id="agv-7",
        timestamp="2026-01-31T10:00:00.250Z",
    )


def report_text(report: dict[str, Any]) -> str:
    """JSON of a report, with numbers rounded as a sensor would."""

    def rounded(value: Any) -> Any:
        return round(value, 3) if isinstance(value, float) else value

    measurements = [{key: rounded(value) for key, value in m.items()} for m in report["measurements"]]
    return json.dumps({**report, "measurements": measurements}, indent=2) + "\n"
