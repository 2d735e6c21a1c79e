"""Tables of results: as CSV files, and as rows for the page."""

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rayfix_evaluation.studies.methods import METHODS
from rayfix_evaluation.studies.store import write_text
from rayfix_evaluation.studies.summary import PERCENTILES

__all__ = ["COLUMNS", "study_rows", "write_tables"]

Document = Mapping[str, Any]

COLUMNS = (
    "point",
    "x",
    "method",
    "drops",
    *(f"{name}{part}" for name in (f"p{p}_m" for p in PERCENTILES) for part in ("", "_low", "_high")),
    "unanswered",
    "gross",
    "rms_error_over_bound",
    *(f"covered_{p}" for p in (50, 68, 90, 99)),
    "bound_p50_m",
    "bound_p90_m",
    "reflected_share",
)
"""Columns of a study's table; percentiles of a method are followed by the ends of their 95 % interval."""


def study_rows(study: Document) -> Iterator[dict[str, Any]]:
    """Rows of a study, one for each point and method; None where there is no number."""
    for point in study["points"]:
        for key, method in point["methods"].items():
            coverage = method["coverage"] or {}
            row = {
                "point": point["label"],
                "x": point["x"],
                "method": key,
                "drops": method["drops"],
                "unanswered": method["unanswered"],
                "gross": method["gross"],
                "rms_error_over_bound": method["rms_error_over_bound"],
                "bound_p50_m": point["bound"]["p50"],
                "bound_p90_m": point["bound"]["p90"],
                "reflected_share": point["reflected_share"],
            }
            for percent in PERCENTILES:
                value, low, high = method[f"p{percent}"]
                row |= {f"p{percent}_m": value, f"p{percent}_m_low": low, f"p{percent}_m_high": high}
            row |= {f"covered_{round(100 * float(p))}": share for p, share in coverage.items()}
            yield {column: row.get(column) for column in COLUMNS}


def write_tables(results: Document, folder: Path) -> None:
    """Write a CSV file for each study; its first lines say where it comes from.

    Raises
    ------
    RayfixError
        When they cannot be written.
    """
    origin = (
        f"# rayfix {results['software_version']}, site {results['site']}, {results['effort']['name']} evaluation, "
        f"seed {results['seed']}, table_id {results['table_id']}\n"
    )
    for study in results["studies"]:
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(study_rows(study))
        write_text(folder / f"{study['key']}.csv", origin + text.getvalue())


def method_label(key: str) -> str:
    """Return a method's label."""
    return METHODS[key].label
