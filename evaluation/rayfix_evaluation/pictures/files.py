"""Common parts of all pictures: orientation of a plan, allowed file names, and errors of writing."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from rayfix_tables.errors import RayfixError
from rayfix_tables.write import check_folder

TYPES = (".png", ".svg", ".pdf")

_DOTS_PER_INCH = 130


def check_picture(path: Path) -> None:
    """Check that a picture can be written under a name.

    Raises
    ------
    RayfixError
        When the type is unknown, or the folder is missing or read-only.
    """
    if path.suffix.lower() not in TYPES:
        raise RayfixError(f"{path} is not a valid name of a picture; end it in {', '.join(TYPES[:-1])} or {TYPES[-1]}")
    check_folder(path, RayfixError)


def set_plan_limits(axes: Axes, along: int, low: ArrayLike, high: ArrayLike) -> None:
    """Show a floor from above: if y runs to the right, x runs down, because the plan must not be mirrored.

    Parameters
    ----------
    along : {0, 1}
        Coordinate that runs to the right.
    low, high : array_like of shape (2,) or more, m
    """
    low, high = np.asarray(low), np.asarray(high)
    across = 1 - along
    bottom, top = (low, high) if across == 1 else (high, low)
    axes.set_xlim(low[along], high[along])
    axes.set_ylim(bottom[across], top[across])
    axes.set_aspect("equal")


def save_picture(figure: Figure, path: str | Path) -> None:
    """Write a figure; the suffix of its file is the type.

    Raises
    ------
    RayfixError
        When it cannot be written.
    """
    path = Path(path)
    check_picture(path)
    try:
        figure.savefig(path, dpi=_DOTS_PER_INCH)
    except OSError as error:
        raise RayfixError(f"cannot write {path} ({error.strerror}); give another name") from error
