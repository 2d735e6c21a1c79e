"""Planning maps from the command line: forecast one table or two, draw the maps, and print a summary."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_evaluation.pictures.files import check_picture
from rayfix_evaluation.planning.forecast import PlanMap, PlanSettings, finite, forecast, summary
from rayfix_evaluation.planning.forecast import Progress as PlanProgress
from rayfix_evaluation.planning.picture import draw_comparison, draw_plan
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table


def plan_settings(
    *,
    height: float,
    azimuth_stdev_deg: float,
    zenith_stdev_deg: float | None,
    timing: Timing,
    range_stdev: float,
    spacing: float,
    threshold: float,
    draws: int,
    seed: int,
    paths: int | None = None,
) -> PlanSettings:
    """Make settings from arguments of the command line, in degrees and metres.

    Raises
    ------
    RayfixError
        If a setting is out of range.
    """
    zenith = azimuth_stdev_deg if zenith_stdev_deg is None else zenith_stdev_deg
    try:
        noise = Noise(
            azimuth_stdev=float(np.deg2rad(azimuth_stdev_deg)),
            zenith_stdev=float(np.deg2rad(zenith)),
            range_stdev=None if timing == "none" else range_stdev,
        )
    except ValueError as error:
        raise RayfixError(str(error)) from error
    return PlanSettings(
        height=height,
        noise=noise,
        timing=timing,
        spacing=spacing,
        threshold=threshold,
        draws=draws,
        seed=seed,
        paths=paths,
    )


def plan_tables(
    tables: list[Path], settings: PlanSettings, output: Path, *, progress: bool
) -> list[tuple[Table, PlanMap]]:
    """Forecast one table or two and write the picture.

    Raises
    ------
    RayfixError
        If a table cannot be opened, nothing is free at the height, or the picture cannot be written.
    """
    check_picture(output)
    opened = [open_checked(path) for path in tables]
    maps = []
    for table in opened:
        with _bar(f"positions of {table.path.name}", enabled=progress) as show:
            maps.append((table, forecast(table, settings, show)))
    if len(maps) == 1:
        draw_plan(output, *maps[0])
    else:
        draw_comparison(output, maps[0], maps[1])
    return maps


def plan_document(table: Table, plan: PlanMap) -> dict[str, Any]:
    """Return a map as JSON-compatible data; None replaces infinity."""
    settings = plan.settings
    return {
        "site": table.site.name,
        **summary(plan),
        "settings": {
            "height_m": settings.height,
            "azimuth_stdev_deg": float(np.degrees(settings.noise.azimuth_stdev)),
            "zenith_stdev_deg": float(np.degrees(settings.noise.zenith_stdev)),
            "times": settings.timing,
            "range_stdev_m": settings.noise.range_stdev,
            "spacing_m": settings.spacing,
            "threshold_m": settings.threshold,
            "draws": settings.draws,
            "seed": settings.seed,
            "paths": settings.paths,
        },
        "map": [
            {
                "position": dict(zip("xyz", plan.position[n].tolist(), strict=True)),
                "error_m": finite(plan.error[n]),
                "bound_m": finite(plan.bound[n]),
                "within_threshold": float(plan.within[n]),
                "heard": {s.id: float(share) for s, share in zip(table.site.stations, plan.audible[n], strict=True)},
            }
            for n in range(len(plan))
        ],
    }


def plan_lines(maps: list[tuple[Table, PlanMap]]) -> Iterator[str]:
    """Summary for the terminal: a line for each map and one for the change."""
    for table, plan in maps:
        figures = summary(plan)
        middle, most = (_metres(figures["error_m"][share]) for share in ("50", "90"))
        yield (
            f"{table.path.name}: {plan.coverage:.1%} of fixes within {plan.settings.threshold:g} m; expected error "
            f"{middle} in half of {len(plan)} squares, {most} in 90 %; {plan.num_audible.mean():.1f} audible stations"
        )
    if len(maps) == 2:
        (_, one), (_, other) = maps
        yield f"change: {100.0 * (other.coverage - one.coverage):+.1f} points of fixes within the threshold"


def _metres(value: float | None) -> str:
    return "no fix" if value is None else f"{value:.2f} m"


@contextmanager
def _bar(text: str, *, enabled: bool) -> Iterator[PlanProgress | None]:
    """Show progress on standard error."""
    if not enabled:
        yield None
        return
    columns = (TextColumn(text), BarColumn(bar_width=20), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(text, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
