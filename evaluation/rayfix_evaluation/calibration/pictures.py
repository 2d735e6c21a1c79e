"""Pictures of a calibration's errors by angle, position and time."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from rayfix_evaluation.calibration.site import SiteCalibration

__all__ = ["draw_errors"]


def draw_errors(calibration: SiteCalibration, folder: Path) -> list[Path]:
    """Draw the errors of each station, before the calibration: by azimuth or length, and by time.

    Parameters
    ----------
    calibration : SiteCalibration
    folder : pathlib.Path
        Of the pictures, one for each station with true positions.
    """
    written = []
    for station_id, errors in calibration.errors.items():
        panels = []
        if errors.angles is not None:
            azimuth, zenith = errors.angles.true.T
            seconds = errors.angles.seconds - errors.angles.seconds.min()
            panels += [
                ("azimuth, deg", "error of azimuth, deg", azimuth, errors.angles.error[:, 0]),
                ("zenith, deg", "error of zenith, deg", zenith, errors.angles.error[:, 1]),
                ("time, s", "error of azimuth, deg", seconds, errors.angles.error[:, 0]),
            ]
        if errors.ranges is not None:
            seconds = errors.ranges.seconds - errors.ranges.seconds.min()
            panels += [
                ("path length, m", "error of range, m", errors.ranges.true, errors.ranges.error),
                ("time, s", "error of range, m", seconds, errors.ranges.error),
            ]
        if not panels:
            continue
        with matplotlib.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
            figure = Figure(figsize=(3.0 * len(panels), 2.6), layout="constrained")
            figure.suptitle(f"station {station_id}: measured minus the twin's path, before the calibration")
            for axes, (across, up, x, y) in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
                axes.plot(x, y, ".", markersize=2, alpha=0.5, color="#1f77b4")
                axes.axhline(0.0, color="0.6", linewidth=0.8)
                axes.set_xlabel(across)
                axes.set_ylabel(up)
            path = folder / f"{_file_name(station_id)}.png"
            figure.savefig(path, dpi=150)
        written.append(path)
    return written


def _file_name(station_id: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in station_id)
