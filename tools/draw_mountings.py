"""Draw the pictures of docs/mounting.md: ``python tools/draw_mountings.py``, or ``make mountings``."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from rayfix_tables.geometry.mounting import FRAMES
from rayfix_tables.site import Mounting

mpl.use("Agg")
import matplotlib.pyplot as plt

DOCS = Path(__file__).resolve().parent.parent / "docs"
INK, BOARD, ANTENNA, BEAM, WALL = "#22303c", "#dce6ee", "#8aa1b4", "#c2410c", "#b9c2ca"
AXES = {"x": "#b91c1c", "y": "#15803d", "z": "#1d4ed8"}
TITLES: dict[Mounting, str] = {
    "3gpp": '"3gpp": TR 38.901 local frame',
    "ublox": '"ublox": u-blox anchor',
    "silabs": '"silabs": Silicon Labs array',
}

# The board is seen from its front, from a little above and to the side: its x axis comes towards the reader.
_TURN, _LIFT = np.deg2rad(38.0), np.deg2rad(22.0)
_RIGHT = np.array([-np.sin(_TURN), np.cos(_TURN), 0.0])
_PAPER = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
_UP = np.array([-np.sin(_LIFT) * np.cos(_TURN), -np.sin(_LIFT) * np.sin(_TURN), np.cos(_LIFT)])


def flat(points: Any) -> Any:
    """Project points of the board's frame, shape (..., 3), to the page, shape (..., 2)."""
    points = np.asarray(points, dtype=float)
    return np.stack([points @ _RIGHT, points @ _UP], axis=-1)


def arrow(axes: Any, begin: Any, end: Any, colour: str, *, width: float = 2.0) -> None:
    """Draw an arrow on the page."""
    axes.annotate(
        "", end, begin, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0}
    )


def arc(axes: Any, begin: Any, towards: Any, degrees: float, radius: float, text: str) -> None:
    """Draw an arc from one direction of the board towards another, with an arrow's head and a text at its end."""
    angle = np.linspace(0.0, np.deg2rad(degrees), 40)[:, None]
    line = flat(radius * (np.cos(angle) * np.asarray(begin) + np.sin(angle) * np.asarray(towards)))
    axes.plot(*line[:-1].T, color=BEAM, lw=1.6, solid_capstyle="butt")
    arrow(axes, line[-3], line[-1], BEAM, width=1.6)
    beside = line[-1] + 0.16 * (line[-1] - line[-4]) / np.linalg.norm(line[-1] - line[-4])
    axes.text(*beside, text, color=BEAM, fontsize=9, ha="center", va="center", bbox=_PAPER)


def draw_frame(axes: Any, mounting: Mounting) -> None:
    """Draw a board with the axes of its local frame and the angles as the vendor counts them."""
    corners = [(0, -0.62, -0.62), (0, 0.62, -0.62), (0, 0.62, 0.62), (0, -0.62, 0.62)]
    axes.fill(*flat(corners).T, color=BOARD, ec=INK, lw=1.2)
    for y in (-0.36, 0.0, 0.36):
        for z in (-0.36, 0.0, 0.36):
            patch = [(0, y + a, z + b) for a, b in ((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1))]
            axes.fill(*flat(patch).T, color=ANTENNA, lw=0)
    axes.plot(*flat([(0, -0.62, 0.62), (0, 0.62, 0.62)]).T, color=INK, lw=4, solid_capstyle="butt")
    axes.text(
        *np.add(flat((0, -0.62, 0.62)), (-0.04, 0.08)), "upper edge", color=INK, fontsize=9, va="bottom", ha="center"
    )
    frame = FRAMES[mounting]
    board = {frame.boresight: (1.0, 0.0, 0.0), frame.up: (0.0, 0.0, 1.0)}
    local = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    for name, axis in local.items():
        ahead = board.get(axis, (0.0, 1.0, 0.0))
        end = flat(1.2 * np.asarray(ahead))
        arrow(axes, (0, 0), end, AXES[name])
        also = ", boresight" if ahead == (1.0, 0.0, 0.0) else ""
        axes.text(
            *(1.15 * end + (0, -0.08 * bool(also))),
            name + also,
            color=AXES[name],
            fontsize=11,
            ha="center",
            va="center",
        )
    ahead, left, up = np.eye(3)
    if mounting == "3gpp":
        arc(axes, ahead, left, 50, 0.85, "azimuth +")
        arc(axes, up, ahead, 50, 0.95, "zenith +")
    elif mounting == "ublox":
        arc(axes, ahead, -left, 50, 0.85, "azimuth +")
        arc(axes, ahead, up, 42, 0.95, "elevation +")
    else:
        arc(axes, left, -up, 60, 0.85, "azimuth +")
        arc(axes, left, ahead, 38, 0.95, "elevation +")
    axes.set_title(TITLES[mounting], fontsize=11, color=INK)
    axes.set_xlim(-1.35, 1.5)
    axes.set_ylim(-1.15, 1.45)


def draw_keys(axes: Any) -> None:
    """Draw from above, from the side and from behind what the three angles are."""
    above, side, behind = axes
    above.set_title("from above: boresight_azimuth_deg", fontsize=11, color=INK)
    above.plot([0, 0], [-1, 1], color=WALL, lw=9)
    arrow(above, (0.1, -0.6), (1.25, -0.6), INK, width=1.2)
    above.text(1.3, -0.6, "+x of the scene", va="center", fontsize=9, color=INK)
    angle = np.deg2rad(35)
    _board(above, (0.12, -0.6), angle)
    _swing(above, (0.1, -0.6), 0, 35, 0.75, "azimuth +", (0.3, 0.0))
    side.set_title("from the side: boresight_downtilt_deg", fontsize=11, color=INK)
    side.plot([0, 0], [-1, 1], color=WALL, lw=9)
    side.plot([0.1, 1.6], [0.5, 0.5], color=INK, lw=0.8, ls="--")
    side.text(1.62, 0.5, "horizon", va="center", fontsize=9, color=INK)
    _board(side, (0.12, 0.5), np.deg2rad(-30))
    _swing(side, (0.1, 0.5), 0, -30, 0.75, "downtilt +", (0.33, 0.0))
    behind.set_title("as the array looks: roll_deg", fontsize=11, color=INK)
    turn = np.deg2rad(-25)
    cosine, sine = np.cos(turn), np.sin(turn)
    square = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]) @ np.array(
        [[cosine, sine], [-sine, cosine]]
    )
    square += (0.75, 0.0)
    behind.fill(*square.T, color=BOARD, ec=INK, lw=1.2)
    behind.plot(*square[2:].T, color=INK, lw=4, solid_capstyle="butt")
    behind.plot([0.75, 0.75], [0, 0.95], color=INK, lw=0.8, ls="--")
    behind.text(0.75, 0.99, "up", ha="center", va="bottom", fontsize=9, color=INK)
    _swing(behind, (0.75, 0.0), 90, 65, 0.8, "roll +", (0.22, 0.05))
    for each in axes:
        each.set_xlim(-0.2, 2.2)
        each.set_ylim(-1.1, 1.4)


def _board(axes: Any, foot: tuple[float, float], angle: float) -> None:
    """Draw a board edge-on, and its boresight."""
    ahead, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    ends = np.array([foot - 0.3 * across, foot + 0.3 * across])
    axes.plot(*ends.T, color=INK, lw=5, solid_capstyle="butt")
    arrow(axes, foot, np.asarray(foot) + 1.25 * ahead, BEAM)
    axes.text(*(np.asarray(foot) + 1.33 * ahead), "boresight", fontsize=9, color=BEAM, va="center")


def _swing(
    axes: Any, centre: Any, begin: float, end: float, radius: float, text: str, beside: tuple[float, float]
) -> None:
    """Draw an arc between two angles in degrees."""
    angle = np.deg2rad(np.linspace(begin, end, 30))
    line = np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    axes.plot(*line[:-1].T, color=BEAM, lw=1.6)
    arrow(axes, line[-3], line[-1], BEAM, width=1.6)
    middle = line[len(line) // 2]
    axes.text(*(middle + beside), text, fontsize=9, color=BEAM, ha="center", va="center")


def main() -> None:
    """Write the pictures."""
    # The same file each time: no date, and names that do not depend on chance.
    with mpl.rc_context({"svg.hashsalt": "rayfix", "svg.fonttype": "path"}):
        for name, columns, draw in (("mounting-frames", 3, _frames), ("mounting-keys", 3, draw_keys)):
            figure, axes = plt.subplots(1, columns, figsize=(11.5, 4.2), layout="constrained")
            for each in axes:
                each.set_aspect("equal")
                each.axis("off")
            draw(axes)
            figure.savefig(DOCS / f"{name}.svg", metadata={"Date": None}, facecolor="white")
            plt.close(figure)


def _frames(axes: Any) -> None:
    for each, mounting in zip(axes, TITLES, strict=True):
        draw_frame(each, mounting)


if __name__ == "__main__":
    main()
