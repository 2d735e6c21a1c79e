"""Calibrate the stations of a site from logs."""

import os
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rayfix.logs.entries import Problem
from rayfix.logs.reading import Reading, ReadState, read_logs
from rayfix_evaluation.calibration.evidence import Evidence, compare_evidence
from rayfix_evaluation.calibration.held_out import HeldOut, judge, only
from rayfix_evaluation.calibration.measured import KnownReport
from rayfix_evaluation.calibration.pictures import draw_errors
from rayfix_evaluation.calibration.site import SiteCalibration, calibrate_site
from rayfix_evaluation.calibration.site_file import calibrated_document
from rayfix_evaluation.calibration.unknown import calibrate_deviations
from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_evaluation.recorded.truth import Truth, read_truth
from rayfix_offline.site import parse_site
from rayfix_service.fusion.measurements.report import Height, Report
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_service.wire import parse_report
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table

_MOST_REPORTS = 4000
"""Reports that a calibration takes; of more, some that are spread evenly over the logs."""

_MARK = "# Written by rayfix calibrate"
"""What a site file begins with that may be replaced by another calibration."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class CalibratedSite:
    """What a calibration has found.

    Attributes
    ----------
    path : pathlib.Path
        The site file that was written.
    calibration : SiteCalibration
    evidence : Evidence
        Of reports, before and after.
    held_out : HeldOut or None
        Which part of the calibration was taken, and why; None without the truth.
    num_reports, num_problems, num_elsewhere : int
        Reports that were used; entries that are none; reports whose true position is not known.
    document : dict
        All of it as JSON-compatible data.
    """

    path: Path
    calibration: SiteCalibration
    evidence: Evidence
    held_out: HeldOut | None
    num_reports: int
    num_problems: int
    num_elsewhere: int
    document: dict[str, Any]


def calibrate_logs(
    table: Table,
    logs: Sequence[Path],
    output: Path,
    *,
    reading: Reading,
    truth_path: Path | None = None,
    height: Height | None = None,
    longest_gap: float = 2.0,
    pictures: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> CalibratedSite:
    """Calibrate the stations of a table's site, and write its site file with what was found.

    Parameters
    ----------
    table : Table
    logs : sequence of pathlib.Path
    output : pathlib.Path
        Site file to write, new or of another calibration; the scene that it names is that of the table's site file.
    reading : Reading
    truth_path : pathlib.Path, optional
        True positions; without them, deviations alone are found.
    height : Height, optional
        For reports without one.
    longest_gap : float, s
        Of the truth.
    pictures : pathlib.Path, optional
        Folder for pictures.
    progress : callable

    Raises
    ------
    ReportError
        When a file cannot be used, or the log says nothing of any station.
    """
    if not output.parent.is_dir():
        raise ReportError(f"there is no folder {output.parent}; make it first")
    _check_free(output)
    truth = None if truth_path is None else read_truth(truth_path, longest_gap=longest_gap)
    progress("reading", 0, 0)
    held_out = None
    known, unknown, num_problems, num_elsewhere = _reports(logs, reading, truth, height)
    if truth is not None:
        if not known:
            raise ReportError(f"no report is of a time that {truth_path} has a position for; check the times of both")
        solver = solver_of(table)
        calibration = calibrate_site(known, table.site, solver, progress=progress)
        held_out = judge(known, table, solver, calibration, progress=progress)
        calibration = only(held_out.part, calibration, table.site)
    else:
        if not unknown:
            raise ReportError("the logs hold no report that can be used; check them by rayfix locate")
        calibration = calibrate_deviations(unknown, table, progress=progress)
    used = [each.report for each in known] if truth is not None else unknown
    progress("evidence", 0, 0)
    evidence = compare_evidence(used, table, calibration.site)
    document = calibrated_document(table.site, dict(calibration.stations))
    parse_site(document, source=str(output))  # what is written can be read
    _write(output, f"{_MARK}, from {len(used)} reports.\n\n{_in_rows(tomli_w.dumps(document))}")
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        draw_errors(calibration, pictures)
    summary = _summary(calibration, evidence, held_out, len(used), num_problems, num_elsewhere)
    return CalibratedSite(
        path=output,
        calibration=calibration,
        evidence=evidence,
        held_out=held_out,
        num_reports=len(used),
        num_problems=num_problems,
        num_elsewhere=num_elsewhere,
        document=summary | {"site": str(output)},
    )


def _reports(
    logs: Sequence[Path], reading: Reading, truth: Truth | None, height: Height | None
) -> tuple[list[KnownReport], list[Report], int, int]:
    known: list[KnownReport] = []
    unknown: list[Report] = []
    problems = elsewhere = 0
    for entry in read_logs(logs, reading, ReadState()):
        try:
            if isinstance(entry, Problem):
                raise ReportError(entry.text)
            report = parse_report(entry.report) if isinstance(entry.report, bytes) else entry.report
        except ReportError:
            problems += 1
            continue
        if report.height is None and height is not None:
            report = replace(report, height=height)
        if truth is None:
            unknown.append(report)
            continue
        seconds = None if report.timestamp is None else utc_moment(report.timestamp).timestamp()
        at = None if seconds is None else truth.at(report.target_id, seconds)
        if at is None or seconds is None:
            elsewhere += 1
            continue
        x, y, z = (float(v) for v in at[0])
        known.append(KnownReport(report=report, position=(x, y, z), seconds=seconds, place=at[1]))
    return _thinned(known), _thinned(unknown), problems, elsewhere


def _thinned(reports: list[Any]) -> list[Any]:
    step = max(1, -(-len(reports) // _MOST_REPORTS))
    return reports[::step]


def _in_rows(text: str) -> str:
    """Write arrays of numbers in one line each, which tomli-w spreads over many."""
    return re.sub(
        r"\[\n((?:\s+[-+.\deE]+,\n)+)\s*\]", lambda found: f"[{', '.join(found[1].replace(',', '').split())}]", text
    )


def _check_free(path: Path) -> None:
    """Refuse a file that someone wrote by hand."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            mine = file.readline().startswith(_MARK)
    except FileNotFoundError:
        return
    except OSError as error:
        raise ReportError(f"{path} cannot be written ({error.strerror}); give another file") from error
    if not mine:
        raise ReportError(f"{path} is there and was not written by rayfix calibrate; give the name of a new file")


def _write(path: Path, text: str) -> None:
    """Write a file beside and rename it into place."""
    try:
        with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=path.parent, delete=False) as file:
            file.write(text)
        os.chmod(file.name, 0o644)
        os.replace(file.name, path)
    except OSError as error:
        raise ReportError(f"{path} cannot be written ({error.strerror}); give another file") from error


def _summary(
    calibration: SiteCalibration,
    evidence: Evidence,
    held_out: HeldOut | None,
    num_reports: int,
    num_problems: int,
    num_elsewhere: int,
) -> dict[str, Any]:
    stations = {}
    for name, found in calibration.stations.items():
        station: dict[str, Any] = {"measurements": found.count, "places": found.places, "notes": list(found.notes)}
        angles, ranges = found.angles, found.ranges
        if angles is not None:
            station["angles"] = {
                "model": angles.model,
                "held_out_log_evidence": angles.evidence,
                "stdev_deg": list(angles.spread.stdev),
                "stdev_relative_error": float(1.0 / np.sqrt(2.0 * max(angles.num_independent, 1.0))),
                "tail_share": angles.spread.tail_share,
                "tail_scale": angles.spread.tail_scale,
                "outlier_share": angles.spread.outlier_share,
                "turn_deg": None if angles.turn is None else angles.turn.tolist(),
                "turn_stdev_deg": None if angles.turn_stdev is None else angles.turn_stdev.tolist(),
                "bias_deg": angles.constant.tolist(),
                "bias_stdev_deg": angles.constant_stdev.tolist(),
                "azimuths_seen_deg": list(angles.azimuth_range),
                "zeniths_seen_deg": list(angles.zenith_range),
                "correlation_s": angles.correlation_time,
                "correlated_share": angles.correlated_share,
            }
        if ranges is not None:
            station["ranges"] = {
                "model": ranges.model,
                "held_out_log_evidence": ranges.evidence,
                "stdev_m": ranges.spread.stdev[0],
                "stdev_relative_error": float(1.0 / np.sqrt(2.0 * max(ranges.num_independent, 1.0))),
                "tail_share": ranges.spread.tail_share,
                "tail_scale": ranges.spread.tail_scale,
                "outlier_share": ranges.spread.outlier_share,
                "bias_m": ranges.bias,
                "bias_stdev_m": ranges.bias_stdev,
                "correlation_s": ranges.correlation_time,
                "correlated_share": ranges.correlated_share,
            }
        stations[name] = station
    return {
        "reports": num_reports,
        "problems": num_problems,
        "reports_of_unknown_positions": num_elsewhere,
        "log_evidence_per_report": {"before": evidence.before, "after": evidence.after, "reports": evidence.count},
        "held_out": None
        if held_out is None
        else {"taken": held_out.part, "reports": held_out.count, "log_evidence_per_report": dict(held_out.evidence)},
        "stations": stations,
    }


def calibration_lines(found: CalibratedSite) -> list[str]:
    """Describe what was found, a line or two for each station."""
    lines = []
    for name, station in found.calibration.stations.items():
        head = f"station '{name}': {station.count} measurements of {station.places} places"
        parts = []
        if station.angles is not None:
            angles = station.angles
            stdev = " and ".join(f"{v:.2f}" for v in angles.spread.stdev)
            parts.append(f"angles scatter by {stdev} deg{_tails(angles.spread.tail_share, angles.spread.tail_scale)}")
            if angles.turn is not None and angles.turn_stdev is not None:
                turns = ", ".join(f"{v:+.2f} ± {s:.2f}" for v, s in zip(angles.turn, angles.turn_stdev, strict=True))
                parts.append(f"turned by {turns} deg about its x, y, z")
            if np.any(angles.constant):
                parts.append(f"biases of {angles.constant[0]:+.2f} and {angles.constant[1]:+.2f} deg")
            if angles.angles is not None:
                parts.append("a bias that depends on the direction")
        if station.ranges is not None:
            ranges = station.ranges
            tails = _tails(ranges.spread.tail_share, ranges.spread.tail_scale)
            parts.append(f"ranges scatter by {ranges.spread.stdev[0]:.3f} m{tails}")
            if ranges.bias_stdev:
                parts.append(f"range bias {ranges.bias:+.3f} ± {ranges.bias_stdev:.3f} m")
        lines.append(f"{head}: {'; '.join(parts) or 'nothing was found'}")
        lines += [f"  {note}" for note in station.notes]
    evidence = found.evidence
    lines.append(
        f"log evidence of a report: {evidence.before:.2f} before, {evidence.after:.2f} after ({evidence.count} reports)"
    )
    if found.held_out is not None:
        lines.append(_taken(found.held_out))
    if found.num_elsewhere:
        lines.append(f"{found.num_elsewhere} reports are of times without a true position")
    if found.num_problems:
        lines.append(f"{found.num_problems} entries are no reports; 'rayfix locate' lists them")
    lines.append(f"{found.path} is written; 'rayfix build {found.path} -o T.h5' puts it into the table in seconds")
    return lines


def _taken(held_out: HeldOut) -> str:
    """Say which part of a calibration was taken, and by what evidence."""
    names = {
        "all": "all of it is taken",
        "systematic": "biases and turns alone are taken, deviations stay as reports state them",
        "deviations": "deviations alone are taken, biases and turns stay as they were",
        "nothing": "none of it is taken: the site as it is explains such reports best",
    }
    evidence = held_out.evidence
    by = f"of {held_out.count} held-out reports" if held_out.count else "of the same reports, for want of places"
    return (
        f"{names[held_out.part]}; log evidence {by}: {evidence['nothing']:.2f} before, "
        f"{evidence['systematic']:.2f} with biases and turns, {evidence['deviations']:.2f} with deviations, "
        f"{evidence['all']:.2f} with both"
    )


def _tails(share: float, scale: float) -> str:
    return f", {share:.0%} of them {scale:.1f} times as far" if share else ""
