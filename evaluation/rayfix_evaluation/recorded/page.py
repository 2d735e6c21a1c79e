"""The score of fixes as pictures and as a page."""

import base64
import html
import io
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from rayfix_evaluation.recorded.score import PROBABILITIES, ScoredFixes

__all__ = ["score_page", "score_picture"]


def score_picture(fixes: ScoredFixes, title: str) -> bytes:
    """Draw the spread of errors, the errors on the map, and how often circles hold, as PNG."""
    with matplotlib.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(12.0, 3.8), layout="constrained")
        figure.suptitle(title)
        spread, where, holds = figure.subplots(1, 3)
        for name, errors in (("horizontal", fixes.horizontal), ("in space", fixes.spatial)):
            spread.plot(np.sort(errors), (np.arange(len(errors)) + 0.5) / len(errors), label=name)
        spread.set_xlabel("error, m")
        spread.set_ylabel("share of fixes with less")
        spread.set_ylim(0.0, 1.0)
        spread.set_xlim(left=0.0)
        spread.legend(frameon=False)
        errors = fixes.horizontal
        drawn = where.scatter(
            fixes.truth[:, 0],
            fixes.truth[:, 1],
            c=errors,
            s=8,
            cmap="viridis",
            vmin=0.0,
            vmax=np.quantile(errors, 0.95),
        )
        where.plot(*np.stack([fixes.truth, fixes.position])[..., :2].transpose(2, 0, 1), color="0.7", lw=0.3, zorder=0)
        where.set_aspect("equal")
        where.set_xlabel("x, m")
        where.set_ylabel("y, m")
        figure.colorbar(drawn, ax=where, label="horizontal error, m")
        stated = np.isfinite(fixes.radius)
        shares = [
            float((errors[known] <= fixes.radius[known, n]).mean()) if (known := stated[:, n]).any() else np.nan
            for n in range(len(PROBABILITIES))
        ]
        holds.plot([0.0, 1.0], [0.0, 1.0], color="0.7", lw=0.8)
        holds.plot(PROBABILITIES, shares, "o")
        holds.set_xlim(0.0, 1.0)
        holds.set_ylim(0.0, 1.0)
        holds.set_xlabel("stated probability of a circle")
        holds.set_ylabel("share of fixes whose circle holds the target")
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=150)
    return picture.getvalue()


def score_page(document: Mapping[str, Any], picture: bytes, title: str) -> str:
    """Write the page: the picture, and tables of errors and circles."""
    groups = [("all fixes", document["all"])]
    groups += [(f"status {name}", group) for name, group in document["by_status"].items()]
    groups += [(f"{name} measurements used", group) for name, group in document["by_measurements_used"].items()]
    rows = "\n".join(_row(name, group) for name, group in groups)
    image = base64.b64encode(picture).decode()
    heads = "".join(
        f"<th>{text}</th>" for text in ("fixes", "places", "mean, m", "50 %, m", "90 %, m", "95 %, m", *_circles())
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title><style>
body {{ font: 15px/1.5 sans-serif; margin: 2em auto; max-width: 76em; padding: 0 1em }}
table {{ border-collapse: collapse }} td, th {{ padding: .2em .7em; text-align: right; border-bottom: 1px solid #ddd }}
td:first-child {{ text-align: left }} small {{ color: #666 }} img {{ max-width: 100% }}
</style></head><body>
<h1>{html.escape(title)}</h1>
<img alt="errors, map and circles" src="data:image/png;base64,{image}">
<table><tr><th></th>{heads}</tr>
{rows}
</table>
<p>Horizontal errors. In small print: intervals that hold a figure with 90 %, by drawing places again. A circle of 68 %
should hold the target of 68 % of the fixes.</p>
</body></html>
"""


def _circles() -> list[str]:
    return [f"in {p:.0%} circle" for p in PROBABILITIES]


def _row(name: str, group: Mapping[str, Any]) -> str:
    cells = [f"<td>{html.escape(name)}</td><td>{group['fixes']}</td><td>{group['places']}</td>"]
    for figure in ("mean", "p50", "p90", "p95"):
        found = group["horizontal_error_m"][figure]
        low, high = found["interval"]
        cells.append(f"<td>{found['value']:.2f}<br><small>{low:.2f} to {high:.2f}</small></td>")
    for probability in PROBABILITIES:
        circle = group["circles"].get(f"{probability:g}")
        if circle is None:
            cells.append("<td>-</td>")
            continue
        low, high = circle["interval"]
        cells.append(f"<td>{circle['holds']:.0%}<br><small>{low:.0%} to {high:.0%}</small></td>")
    return f"<tr>{''.join(cells)}</tr>"
