"""Output of the command line on recorded logs."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.table import Table as Grid

if TYPE_CHECKING:
    from rayfix.logs.run import LogRun
    from rayfix.logs.summary import StationFigures, Summary

_LISTED = 5


def print_log_run(run: "LogRun", output: Path, *, as_json: bool) -> None:
    """Print what became of logs: the summary, and on standard error what was left out."""
    summary = run.summary
    if run.unread_columns:
        print(f"columns that are not read: {', '.join(run.unread_columns)}", file=sys.stderr)
    for line in run.first_problems[:_LISTED]:
        print(line, file=sys.stderr)
    if summary.problems:
        count = "1 entry was" if summary.problems == 1 else f"{summary.problems} entries were"
        print(f"{count} left out; {run.problems_path} lists them with the reasons", file=sys.stderr)
    if as_json:
        print(json.dumps(summary.document() | {"output": str(output), "resumed": run.resumed}, indent=2))
        return
    console = Console()
    statuses = ", ".join(f"{count} {status}" for status, count in sorted(summary.statuses.items()))
    resumed = f", {run.resumed} entries of them before an interruption" if run.resumed else ""
    fixes = "1 fix" if summary.fixes == 1 else f"{summary.fixes} fixes"
    console.print(
        f"{fixes} in {output}{resumed}" + (f": {statuses}" if statuses else ""),
        highlight=False,
        soft_wrap=True,
    )
    console.print(_stations(summary))
    for line in _suspected(summary):
        console.print(line, highlight=False, soft_wrap=True)


def _stations(summary: "Summary") -> Grid:
    grid = Grid("station", box=box.SIMPLE_HEAD, caption_justify="left")
    for heading in ("reports", "used", "outliers", "azimuth, deg", "zenith, deg", "range, m"):
        grid.add_column(heading, justify="right")
    for name, figures in summary.stations.items():
        grid.add_row(
            name,
            f"{figures.reports:,}",
            f"{figures.used:,}",
            f"{figures.outliers:,}",
            *(_residual(figures, quantity) for quantity in ("azimuth_deg", "zenith_deg", "range_m")),
        )
    grid.caption = (
        "mean and standard deviation of measured minus straight path to the fix, of fixes with status ok; "
        "(deviation that the fixes assume)"
    )
    return grid


def _residual(figures: "StationFigures", quantity: str) -> str:
    moments = figures.residuals.get(quantity)
    if moments is None:
        return "-"
    digits = 2 if quantity == "range_m" else 1
    return f"{moments.mean:+.{digits}f} ± {moments.deviation:.{digits}f} ({moments.assumed:.{digits}f})"


def _suspected(summary: "Summary") -> list[str]:
    """Say which stations seem to be biased."""
    lines = []
    for name, figures in summary.stations.items():
        for quantity, moments in sorted(figures.residuals.items()):
            if moments.biased:
                what, unit = quantity.rsplit("_", 1)
                lines.append(
                    f"station '{name}' may have a bias of {moments.mean:+.2g} {unit} in its {what}: "
                    f"its {moments.count} residuals have this mean and scatter by {moments.deviation:.2g} {unit}"
                )
    return lines
