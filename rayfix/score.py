"""Score the fixes of a log against true positions."""

import csv
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from rayfix.extras import needs_extra
from rayfix.logs.layouts import RADII
from rayfix_evaluation.recorded.page import score_page, score_picture
from rayfix_evaluation.recorded.score import ScoredFixes, score_document
from rayfix_evaluation.recorded.truth import read_truth
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_tables.errors import ReportError


@dataclass(frozen=True, kw_only=True)
class Score:
    """A score.

    Attributes
    ----------
    document : dict
        All figures as JSON-compatible data.
    files : tuple of pathlib.Path
        That were written.
    unread : tuple of str
        Columns of the truth that were not read.
    """

    document: dict[str, Any]
    files: tuple[Path, ...]
    unread: tuple[str, ...]


def score_fixes(
    fixes_path: Path,
    truth_path: Path,
    folder: Path | None = None,
    *,
    longest_gap: float = 2.0,
    use_track: bool = False,
) -> Score:
    """Compare the fixes of a file with true positions.

    Parameters
    ----------
    fixes_path : pathlib.Path
        Written by ``rayfix locate -o``: .jsonl, .csv, .geojson or .parquet.
    truth_path : pathlib.Path
        CSV; see :func:`~rayfix_evaluation.recorded.truth.read_truth`.
    folder : pathlib.Path, optional
        For ``score.html``, ``score.png`` and ``score.json``.
    longest_gap : float, s
        Between points of the truth, up to which targets moved evenly.
    use_track : bool
        Whether positions are those of tracks.

    Raises
    ------
    ReportError
        When a file cannot be used, or no fix has a true position.
    """
    truth = read_truth(truth_path, longest_gap=longest_gap)
    rows: list[tuple[Any, ...]] = []
    without_position = elsewhere = timeless = 0
    for fix in read_fixes(fixes_path):
        if fix.get("timestamp") is None:
            timeless += 1
            continue
        at = truth.at(fix.get("target_id"), utc_moment(fix["timestamp"]).timestamp())
        if at is None:
            elsewhere += 1
            continue
        prefix = "track_" if use_track else ""
        position = [_number(fix.get(f"{prefix}{axis}_m")) for axis in "xyz"]
        if not all(map(math.isfinite, position)):
            without_position += 1
            continue
        radii = [math.nan if use_track else _number(fix.get(f"radius_{round(100 * p)}_m")) for p in RADII]
        rows.append((position, at[0], radii, fix["status"], int(float(fix["num_used"])), at[1]))
    if not rows:
        if use_track and not timeless + elsewhere:
            raise ReportError(f"no fix of {fixes_path} has a track; locate the log by rayfix locate --track")
        raise ReportError(
            f"no fix of {fixes_path} has a position at a time that {truth_path} knows: {timeless} have no time, "
            f"{elsewhere} are of other times, {without_position} have no position; check times and target_id of both"
        )
    positions, trues, all_radii, statuses, counts, places = zip(*rows, strict=True)
    scored = ScoredFixes(
        position=np.array(positions),
        truth=np.array(trues),
        radius=np.array(all_radii),
        status=np.array(statuses),
        num_used=np.array(counts),
        place=np.array(places),
    )
    left_out = {"no_position": without_position, "no_true_position": elsewhere, "no_time": timeless}
    document = score_document(scored) | {"left_out": left_out}
    files = () if folder is None else _write(document, scored, folder, f"{fixes_path.name} beside {truth_path.name}")
    return Score(document=document, files=files, unread=truth.unread)


def read_fixes(path: Path) -> Iterator[Mapping[str, Any]]:
    """Give the fixes of a file as flat rows.

    Raises
    ------
    ReportError
        When the file is none of fixes.
    """
    try:
        match path.suffix.lower():
            case ".jsonl":
                from rayfix.logs.layouts import flat

                with path.open(encoding="utf-8") as file:
                    for line in file:
                        yield flat(_fix_of(json.loads(line), path))
            case ".csv":
                with path.open(encoding="utf-8", newline="") as file:
                    for row in csv.DictReader(file):
                        yield {name: value or None for name, value in _fix_of(row, path).items()}
            case ".geojson":
                for feature in json.loads(path.read_text(encoding="utf-8"))["features"]:
                    yield feature["properties"]
            case ".parquet":
                with needs_extra("parquet"):
                    from pyarrow.parquet import ParquetFile
                for batch in ParquetFile(path).iter_batches():
                    yield from batch.to_pylist()
            case _:
                raise ReportError(
                    f"{path} is none of .jsonl, .csv, .geojson and .parquet; 'rayfix locate -o' writes them"
                )
    except OSError as error:
        raise ReportError(f"{path} cannot be read ({error.strerror or error}); give a file of fixes") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ReportError(f"{path} holds no fixes as 'rayfix locate -o' writes them ({error})") from error


def _fix_of(document: Any, path: Path) -> Mapping[str, Any]:
    if isinstance(document, Mapping) and "status" not in document and {"measurements", "type"} & document.keys():
        raise ReportError(
            f"{path} is a log of reports, not of fixes; locate it first: rayfix locate TABLE.h5 {path} -o FIXES.jsonl"
        )
    return cast("Mapping[str, Any]", document)


def score_lines(score: Score) -> list[str]:
    """Describe a score."""
    document = score.document
    lines = []
    groups = [("all", document["all"])]
    groups += [(f"status {name}", group) for name, group in document["by_status"].items()]
    groups += [(f"{name} measurements used", group) for name, group in document["by_measurements_used"].items()]
    for name, group in groups:
        errors = group["horizontal_error_m"]
        figures = ", ".join(
            "{} {:.2f} m ({:.2f} to {:.2f})".format(label, errors[key]["value"], *errors[key]["interval"])
            for label, key in (("mean", "mean"), ("50 %", "p50"), ("90 %", "p90"))
        )
        circles = ", ".join(f"{float(p):.0%} circle {c['holds']:.0%}" for p, c in group["circles"].items())
        held = f"; held by {circles}" if circles else ""
        lines.append(f"{name}: {group['fixes']} fixes of {group['places']} places: {figures}{held}")
    left_out = document["left_out"]
    if any(left_out.values()):
        lines.append(
            f"left out: {left_out['no_true_position']} fixes of times without a true position, "
            f"{left_out['no_position']} without a position, {left_out['no_time']} without a time"
        )
    if score.unread:
        lines.append(f"columns of the truth that are not read: {', '.join(score.unread)}")
    if score.files:
        lines.append(f"written: {', '.join(map(str, score.files))}")
    return lines


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _write(document: Mapping[str, Any], scored: ScoredFixes, folder: Path, title: str) -> tuple[Path, ...]:
    picture = score_picture(scored, title)
    contents = {
        "score.html": score_page(document, picture, title).encode(),
        "score.png": picture,
        "score.json": json.dumps(document, indent=2).encode(),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (folder / name).write_bytes(content)
    except OSError as error:
        raise ReportError(f"{folder} cannot be written ({error.strerror}); give another folder") from error
    return tuple(folder / name for name in contents)
