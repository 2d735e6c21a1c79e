"""Output of the command line: summaries, tables and fixes."""

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table as Grid

from rayfix_tables.part import Update
from rayfix_tables.table import Table

if TYPE_CHECKING:
    from rayfix_offline.build import BuildSummary
    from rayfix_offline.check import Check

MOST_WALLS = 6
"""Columns of the summary of a build for numbers of walls."""


def print_evaluation(results: Mapping[str, Any], page: Path) -> None:
    """Print the main results of an evaluation and the path of its report."""
    grid = Grid(title=f"{results['site']}: error of the position, m", title_justify="left", box=box.SIMPLE_HEAD)
    grid.add_column("measured")
    for heading in ("rayfix 50 %", "90 %", "paper 50 %", "90 %", "bound 50 %", "90 %"):
        grid.add_column(heading, justify="right")
    (study,) = [study for study in results["studies"] if study["key"] == "methods"]
    for point in study["points"]:
        summaries = [point["methods"][key][name][0] for key in ("rayfix", "paper") for name in ("p50", "p90")]
        values = [*summaries, point["bound"]["p50"], point["bound"]["p90"]]
        grid.add_row(point["label"], *("-" if value is None else f"{value:.3f}" for value in values))
    console = Console()
    console.print(grid)
    for statement in results["statements"]:
        verdict = "holds" if statement["holds"] else "does not hold"
        console.print(f"[bold]{verdict:<13}[/bold]  {statement['method']}: {statement['claim']}", highlight=False)
    console.print(f"The report is {page}", highlight=False, soft_wrap=True)


def print_check(check: "Check") -> None:
    """Print a line for each finding, one for the lost rays, and a summary; wrapped on a terminal."""
    lines = [f"{finding.severity}: {finding.message}" for finding in check.findings]
    twin = check.twin
    if check.escapes:
        escaped = ", ".join(f"{escapes.station_id} {escapes.share:.2%}" for escapes in check.escapes)
        lines.append(f"rays that leave the scene: {escaped}")
    windows = ", ".join(f"{window:g}" for window in check.windows_deg)
    lines.append(
        f"windows of {windows} deg: angles with deviations of up to {check.best_up_to_deg:.3g} deg are looked up in "
        f"one cell, up to {check.integrated_from_deg:.3g} deg in several; wider ones, and times alone, are integrated "
        f"on the path map; beside times of unknown clocks, angles of up to {check.quick_up_to_deg:.3g} deg are quick"
    )
    size = " x ".join(f"{length:.6g}" for length in twin.scene.bounds[1] - twin.scene.bounds[0])
    curved = f" in {twin.planes.num_surfaces:,} surfaces" if twin.planes.curved else ""
    lines.append(
        f"{check.site_path}: scene of {size} m with {len(twin.scene.faces):,} triangles on {len(twin.planes):,} planes"
        f"{curved}, {twin.free_space.volume:,.0f} m3 of free space; {counted(check.num_errors, 'error')}, "
        f"{counted(len(check.findings) - check.num_errors, 'warning')}"
    )
    console = Console()
    for line in lines:
        wrapped = textwrap.fill(
            line, min(100, console.width), subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
        )
        print(wrapped if console.is_terminal else line)


def print_build_summary(summary: "BuildSummary") -> None:
    """Print a line per station and one for the table."""
    grid = Grid(
        "station",
        title=f"Table {summary.path}",
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
        pad_edge=False,
    )
    for heading in ("", "cells", "filled", "tubes", "MB", "lost"):
        grid.add_column(heading, justify="right")
    for k in range(max(len(s.coverage) for s in summary.stations)):
        grid.add_column(f"<= {k}", justify="right")
    for s in summary.stations:
        grid.add_row(
            s.station_id,
            s.origin,
            str(s.num_cells),
            str(s.num_filled_cells),
            str(s.num_components),
            f"{s.num_bytes / 1e6:.1f}",
            f"{s.lost_ray_share:.3%}",
            *(f"{share:.0%}" for share in s.coverage),
        )
    grid.caption = (
        "filled: cells with rays; tubes: components of their mixtures; lost: rays that left the scene; "
        "<= k: fraction of the free space that paths with at most k reflections reach"
    )
    console = Console()
    console.print(grid)
    if any(s.wall_coverage for s in summary.stations):
        console.print(_wall_grid(summary))
    for s in summary.stations:
        if s.origin == "updated":
            kept = _kept(s.num_kept_cells, s.num_finest_cells, s.largest_change)
            console.print(f"{s.station_id}: {kept}", highlight=False)
    console.print(
        f"{summary.num_bytes / 1e6:.1f} MB in {summary.seconds:.1f} s, at most {summary.peak_bytes / 1e9:.1f} GB of "
        f"memory; table_id {summary.table_id}",
        highlight=False,
        soft_wrap=True,
    )


def _wall_grid(summary: "BuildSummary") -> Grid:
    """Tabulate how far straight paths through walls reach."""
    grid = Grid(
        "station",
        title="Straight paths through walls",
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
        pad_edge=False,
    )
    most = max(len(s.wall_coverage) for s in summary.stations)
    for k in range(min(most, MOST_WALLS)):
        grid.add_column(f"<= {k}", justify="right")
    grid.add_column("cut off", justify="right")
    for s in summary.stations:
        shares = [f"{share:.0%}" for share in s.wall_coverage[:MOST_WALLS]]
        grid.add_row(s.station_id, *shares, *[""] * (min(most, MOST_WALLS) - len(shares)), f"{s.cut_power_share:.2%}")
    grid.caption = (
        "<= k: fraction of the free space that straight paths through at most k walls reach, 0 being line of sight; "
        "cut off: power whose rays ended for weakness"
    )
    return grid


def _kept(num_kept: int, num_cells: int, largest_change: float) -> str:
    """Describe how many cells were kept from the former table, and by how much they may differ."""
    share = f"{num_kept:,} of {num_cells:,} finest cells kept"
    return f"{share}, changed by at most {largest_change:.2%}" if largest_change else f"{share}, all of them exact"


def table_info(table: Table) -> dict[str, Any]:
    """Facts about a table, as JSON-compatible data."""
    return {
        "path": str(table.path),
        "table_id": table.table_id,
        "format_version": table.format_version,
        "software_version": table.software_version,
        "site": table.site.name,
        "bytes": table.path.stat().st_size,
        "faces": len(table.scene.faces),
        "free_space_m3": round(table.scene.free_space.volume, 3),
        "opaque_walls": not table.passes_walls,
        "origin_m": table.scene.origin.tolist(),
        "stations": [
            {
                "id": station_id,
                "position_m": list(part.station.position),
                "lost_ray_share": part.lost_ray_share,
                "coverage": list(part.coverage),
                "wall_coverage": list(part.wall_coverage),
                "cut_power_share": part.cut_power_share,
                "update": _update_info(part.update),
                "levels": [
                    {
                        "window_deg": round(float(np.rad2deg(level.window)), 9),
                        "cells": level.num_cells,
                        "components": level.num_components,
                    }
                    for level in part.levels
                ],
            }
            for station_id, part in table.parts.items()
        ],
    }


def _update_info(update: Update | None) -> dict[str, Any] | None:
    """Describe how far a station may differ from a new build; None if it is equal."""
    if update is None:
        return None
    return {
        "tolerance": update.tolerance,
        "changed_cells": update.num_changed,
        "largest_change": update.largest_change,
        "exact_part_id": update.exact_part_id,
        "former_part_id": update.former_part_id,
    }


def print_table_info(table: Table) -> None:
    """Print facts about a table."""
    facts = table_info(table)
    console = Console()
    for line in (
        f"{facts['path']}: site '{facts['site']}', {facts['bytes'] / 1e6:.1f} MB",
        f"table_id {facts['table_id']}",
        f"format {facts['format_version']}, written by rayfix {facts['software_version']}",
        f"scene of {facts['faces']:,} triangles, {facts['free_space_m3']:,.0f} m3 of free space",
        walls_of(table),
    ):
        console.print(line, highlight=False, soft_wrap=True)
    if any(facts["origin_m"]):
        origin = ", ".join(f"{v:.0f}" for v in facts["origin_m"])
        console.print(f"positions in the table are relative to ({origin}) m", highlight=False, soft_wrap=True)
    grid = Grid("station", "position, m", box=box.SIMPLE_HEAD)
    for heading in ("window, deg", "cells", "components"):
        grid.add_column(heading, justify="right")
    for station in facts["stations"]:
        for n, level in enumerate(station["levels"]):
            grid.add_row(
                station["id"] if n == 0 else "",
                ", ".join(f"{round(v, 6):.10g}" for v in station["position_m"]) if n == 0 else "",
                f"{level['window_deg']:g}",
                f"{level['cells']:,}",
                f"{level['components']:,}",
            )
    console.print(grid)
    for station in facts["stations"]:
        if station["update"]:
            cells = sum(level["cells"] for level in station["levels"])
            update = station["update"]
            console.print(
                f"{station['id']}: {update['changed_cells']:,} of {cells:,} cells differ from those of a new build, "
                f"by at most {update['largest_change']:.2%} (tolerance {update['tolerance']:.2%}); build without "
                "--tolerance to make it exact",
                highlight=False,
                soft_wrap=True,
            )


def walls_of(table: Table) -> str:
    """Say what a table takes its walls for, and why."""
    if table.passes_walls:
        return "walls of known material and thickness let signals through"
    if table.site.document.get("propagation", {}).get("transmission") is False:
        return "all walls were taken for opaque, as the site file says: transmission = false"
    return "all walls were taken for opaque: no material lets signals through"


def print_fix(document: Mapping[str, Any]) -> None:
    """Print the answer to a report."""
    if document["position"] is None:
        print(f"{document['status']}: no measurement could be used")
    elif document["status"] == "inconsistent":
        # The probabilities assume that the model fits the measurements, which it does not here.
        print(f"inconsistent: {place(document['position'])} is only the best guess")
    else:
        print(f"{document['status']}: {place(document['position'])}")
        print(
            f"  within {document['horizontal_accuracy_m']:.2f} m horizontally and "
            f"{document['vertical_accuracy_m']:.2f} m vertically with a probability of {document['confidence']:.0%}"
        )
        for n, candidate in enumerate(document["candidates"]):
            name = "this position" if n == 0 else f"rival {n}: {place(candidate['position'])},"
            print(f"  {name} has a probability of {candidate['probability']:.1%}")
    for warning in document.get("warnings", ()):
        print(f"  {warning}")
    for outcome in document["measurements"]:
        if not outcome["used"]:
            print(f"  measurement {outcome['index']} not used: {outcome['reason']}")
        elif outcome["outlier_probability"] > 0.5 and "warnings" not in document:
            print(f"  measurement {outcome['index']} is an outlier ({outcome['outlier_probability']:.0%})")


def counted(number: int, noun: str) -> str:
    """Return a number and its noun, in the plural unless it is one."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def place(position: Mapping[str, float]) -> str:
    """Format the coordinates of a position."""
    return f"({position['x']:.2f}, {position['y']:.2f}, {position['z']:.2f}) m"
