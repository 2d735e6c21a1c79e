"""The fixes of a log as the viewer plays them, with where the targets really were."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rayfix.errors import ViewError
from rayfix_evaluation.recorded.truth import Truth, read_truth
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_tables.errors import ReportError

MOST_FIXES = 20_000
"""A page with more would be too large for browsers."""

_LEFT_OUT = ("log", "entry", "horizontal_radii_m")
"""What the viewer does not show."""


def read_recording(path: Path, truth_path: Path | None = None, *, longest_gap: float = 2.0) -> dict[str, Any]:
    """Read the fixes of a log.

    Parameters
    ----------
    path : pathlib.Path
        JSON lines of ``rayfix locate -o``.
    truth_path : pathlib.Path, optional
        CSV; see :func:`~rayfix_evaluation.recorded.truth.read_truth`.
    longest_gap : float, s
        Between points of the truth, up to which targets moved evenly.

    Returns
    -------
    dict
        ``name`` and ``events``, in the form of the viewer's events.

    Raises
    ------
    ReportError
        When a file cannot be read.
    ViewError
        When the file holds no fixes, or too many, or none has a true position.
    """
    truth = None if truth_path is None else read_truth(truth_path, longest_gap=longest_gap)
    events: list[dict[str, Any]] = []
    for fix in _fixes(path):
        if len(events) == MOST_FIXES:
            raise ViewError(
                f"{path} has more than {MOST_FIXES} fixes, too many for a page; give a part of it, or drop the file on "
                "the viewer of 'rayfix serve'"
            )
        report = fix.pop("report", {"measurements": []})
        event = {"report": report, "fix": fix, "source": "log"}
        if truth is not None and (at := _true_position(truth, fix)) is not None:
            event["truth"] = at
        events.append(event)
    if not events:
        raise ViewError(f"{path} holds no fixes; write them by 'rayfix locate T.h5 LOG -o FIXES.jsonl'")
    if truth is not None and not any("truth" in event for event in events):
        raise ViewError(f"{truth_path} has no true position at the times of {path}; check times and target_id of both")
    return {"name": path.name, "events": events}


def _fixes(path: Path) -> Iterator[dict[str, Any]]:
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                if not line.strip():
                    continue
                try:
                    fix = json.loads(line)
                except ValueError:
                    fix = None
                if not isinstance(fix, dict) or not {"status", "candidates", "measurements", "position"} <= fix.keys():
                    raise ViewError(
                        f"{path}, line {number} is no fix; give a file that 'rayfix locate T.h5 LOG -o FIXES.jsonl' "
                        "wrote"
                    )
                yield {name: value for name, value in fix.items() if name not in _LEFT_OUT}
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8"
        raise ReportError(f"{path} cannot be read ({reason}); give a file of fixes") from error


def _true_position(truth: Truth, fix: dict[str, Any]) -> list[float] | None:
    if fix.get("timestamp") is None:
        return None
    found = truth.at(fix.get("target_id"), utc_moment(fix["timestamp"]).timestamp())
    return None if found is None else [float(value) for value in found[0]]
