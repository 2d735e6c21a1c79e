"""Real ranges: a trolley with three UWB tags among eight anchors, and motion capture as the truth.

Reads the data set "dynamic, fast" of H. Jiang (MIT licence); see docs/real-data.md. Of the motion capture's four
quaternion columns, the second is the real part and the third the rotation about z. The data set states another order,
with which the trolley would lie on its back and ranges would scatter by 0.23 m instead of 0.08 m. The trolley rolls on
a flat floor, so only the rotation about z is used.
"""

import csv
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from rayfix_tables.errors import RayfixError

ANCHORS = np.array(
    [
        [-3.4203, 3.0053, 1.0442],
        [0.0016, 3.0110, 1.0446],
        [3.6056, 2.9795, 1.0463],
        [3.6011, -0.0008, 1.0422],
        [3.5674, -3.0087, 1.0443],
        [-0.0072, -2.9652, 1.0444],
        [-3.4673, -2.9587, 1.0445],
        [-3.4858, -0.0098, 1.0457],
    ]
)
"""Positions of the anchors, m."""

TAGS = np.array([[-0.0689, -0.1423, 0.0011], [-0.0750, 0.1402, 0.0016], [0.2034, 0.1451, -0.0008]])
"""Positions of the tags on the trolley, m."""


@dataclass(frozen=True, kw_only=True)
class Ranging:
    """Ranges of tags to anchors with the true positions of the tags.

    Attributes
    ----------
    time : ndarray of shape (n,), s
        Since the first report.
    measured : ndarray of shape (n, n_anchors, n_tags), m
        Ranges; NaN where there is none.
    truth : ndarray of shape (n, n_tags, 3), m
    """

    time: NDArray[np.float64]
    measured: NDArray[np.float64]
    truth: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of reports of all tags."""
        return len(self.time)

    def part(self, begin: float, end: float) -> "Ranging":
        """Cut out the reports between two shares of the whole time, 0 to 1."""
        inside = (self.time >= begin * self.time[-1]) & (self.time < end * self.time[-1])
        return Ranging(time=self.time[inside], measured=self.measured[inside], truth=self.truth[inside])

    def residuals(self) -> NDArray[np.float64]:
        """Measured less true ranges, of the shape of ``measured``, m."""
        true = np.linalg.norm(self.truth[:, None] - ANCHORS[:, None], axis=-1)
        return np.asarray(self.measured - true)


def read_ranging(folder: Path) -> Ranging:
    """Read ranges, and the tags' true positions at their times, interpolated.

    Parameters
    ----------
    folder : Path
        With ``UWB_dynamic_exp_fast.csv`` and ``motion_capture_dynamic_exp_fast.csv``.

    Raises
    ------
    RayfixError
        When a file is missing or is not what it should be.
    """
    time, ranges = _read(folder / "UWB_dynamic_exp_fast.csv", columns=24, skip=0)
    seen, motion = _read(folder / "motion_capture_dynamic_exp_fast.csv", columns=7, skip=1)
    inside = (time >= seen[0]) & (time <= seen[-1])
    time, ranges = time[inside], ranges[inside]
    # A quaternion and its negative are one turn, so the angle is unwrapped before it is interpolated.
    turn = np.unwrap(2.0 * np.arctan2(motion[:, 5], motion[:, 4]))
    middle = np.stack([np.interp(time, seen, motion[:, axis]) for axis in range(3)], axis=-1)
    cosine, sine = np.cos(np.interp(time, seen, turn)), np.sin(np.interp(time, seen, turn))
    x = cosine[:, None] * TAGS[:, 0] - sine[:, None] * TAGS[:, 1]
    y = sine[:, None] * TAGS[:, 0] + cosine[:, None] * TAGS[:, 1]
    truth = middle[:, None, :] + np.stack([x, y, np.broadcast_to(TAGS[:, 2], x.shape)], axis=-1)
    return Ranging(time=time - time[0], measured=ranges.reshape(-1, len(ANCHORS), len(TAGS)), truth=truth)


def least_squares(
    anchors: NDArray[np.float64], ranges: NDArray[np.float64], *, height: float | None = None
) -> NDArray[np.float64]:
    """Position whose distances fit ranges best, all alike (Gauss-Newton from the middle of the anchors).

    Parameters
    ----------
    anchors : ndarray of shape (n, 3), m
    ranges : ndarray of shape (n,), m
    height : float, m, optional
        Known z; without it z is found too, from half a metre below the anchors.

    Returns
    -------
    ndarray of shape (3,), m
    """
    free = 3 if height is None else 2
    x = anchors.mean(axis=0)
    x[2] = x[2] - 0.5 if height is None else height
    for _ in range(50):
        apart = x - anchors
        distance = np.maximum(np.linalg.norm(apart, axis=1), 1e-9)
        step, *_ = np.linalg.lstsq((apart / distance[:, None])[:, :free], ranges - distance, rcond=None)
        # Nearly level anchors hardly say z: no step may leave the room.
        x[:free] += np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-6:
            break
    return np.asarray(x)


def site_text(scene: str, bias: NDArray[np.float64], *, window_deg: float) -> str:
    """Site file of the anchors in a scene file, without reflections.

    Parameters
    ----------
    bias : ndarray of shape (n_anchors,), m
        Of each anchor's ranges.
    """
    document = {
        "site": {"name": "uwb", "scene": scene},
        "propagation": {"max_reflections": 0, "max_path_length_m": 20.0},
        "table": {"windows_deg": [window_deg]},
        "stations": [
            {
                "id": f"a{n}",
                "position_m": [float(value) for value in position],
                "bias": {"range_m": round(float(bias[n]), 4)},
            }
            for n, position in enumerate(ANCHORS)
        ],
    }
    return tomli_w.dumps(document)


def _read(path: Path, *, columns: int, skip: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read times [s of the day] and the columns after them; NaN for an empty field."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))[skip:]
        times = [datetime.strptime(row[0], "%Y-%m-%d %H:%M:%S.%f") for row in rows]
        values = [[float(field or "nan") for field in row[1 : columns + 1]] for row in rows]
        table = np.array(values).reshape(len(rows), columns)
    except OSError as error:
        raise RayfixError(f"{path} cannot be read ({error.strerror}); name the folder of the data set") from error
    except ValueError as error:
        raise RayfixError(f"{path} is not as expected: {error}; take the data set's file unchanged") from error
    midnight = times[0].replace(hour=0, minute=0, second=0, microsecond=0)
    return np.array([(time - midnight).total_seconds() for time in times]), table
