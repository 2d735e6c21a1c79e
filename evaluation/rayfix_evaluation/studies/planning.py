"""Planning maps of a site: forecasts from its table alone, for two sets of measurements."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_evaluation.planning.floor import slice_mesh
from rayfix_evaluation.planning.forecast import PlanMap, PlanSettings, forecast, summary
from rayfix_tables.table import Table

__all__ = ["plan_site"]

_ABOVE_FLOOR = 1.0
"""Height of the transmitters above the lowest free position, m; in low buildings, half of the building's height."""

_NOISE = Noise(azimuth_stdev=float(np.deg2rad(1.0)), zenith_stdev=float(np.deg2rad(1.0)), range_stdev=0.5)


def plan_site(table: Table, *, spacing: float, seed: int) -> dict[str, Any]:
    """Forecast fixes over a site's floor, with angles of 1 deg, alone and with propagation times of 0.5 m.

    Parameters
    ----------
    spacing : float, m
        Side of the map's squares.

    Returns
    -------
    dict
        JSON-compatible: the floor plan, and a map with its summary for each set of measurements. Lengths in m.
    """
    free_space = table.scene.free_space
    extent = free_space.free.shape[2] * free_space.voxel_size
    height = float(free_space.origin[2] + min(_ABOVE_FLOOR, 0.5 * extent))
    timings: tuple[tuple[str, Timing], ...] = (("AoA 1 deg", "none"), ("AoA 1 deg + PT 0.5 m", "pt"))
    maps = []
    for label, timing in timings:
        settings = PlanSettings(height=height, noise=_NOISE, timing=timing, spacing=spacing, seed=seed)
        maps.append({"label": label, **_document(forecast(table, settings))})
    walls = slice_mesh(table.scene.vertices, table.scene.faces, height)
    return {"height_m": round(height, 3), "spacing_m": spacing, "walls_m": np.round(walls, 3).tolist(), "maps": maps}


def _document(plan: PlanMap) -> dict[str, Any]:
    figures = summary(plan)
    return {
        "threshold_m": plan.settings.threshold,
        "coverage": round(figures["coverage"], 4),
        "expected_error_m": {name: None if v is None else round(v, 4) for name, v in figures["error_m"].items()},
        "stations_heard": round(figures["stations_heard"]["mean"], 2),
        "position_m": np.round(plan.position[:, :2], 3).tolist(),
        "error_m": _numbers(plan.error),
        "within": _numbers(plan.within),
        "heard": _numbers(plan.num_audible),
    }


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [round(float(v), 4) if np.isfinite(v) else None for v in values]
