"""How fixes are written: JSON lines, CSV, GeoJSON, and Parquet by way of JSON lines."""

import csv
import io
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic_core import to_json

from rayfix.extras import needs_extra
from rayfix_tables.errors import ReportError

Layout = Literal["jsonl", "csv", "geojson", "parquet"]

_SUFFIXES: dict[str, Layout] = {".jsonl": "jsonl", ".csv": "csv", ".geojson": "geojson", ".parquet": "parquet"}

RADII = (0.5, 0.68, 0.9, 0.95)
"""Probabilities of the circles that each fix of a log has."""

_TEXTS = ("log", "target_id", "timestamp", "status", "warnings", "track_state")
_INTEGERS = ("entry", "num_measurements", "num_used", "num_outliers")
_COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2")

FIX_COLUMNS = (
    "log",
    "entry",
    "target_id",
    "timestamp",
    "status",
    "x_m",
    "y_m",
    "z_m",
    "probability",
    "horizontal_accuracy_m",
    "vertical_accuracy_m",
    "confidence",
    *(f"radius_{round(100 * p)}_m" for p in RADII),
    *_COVARIANCE,
    "num_measurements",
    "num_used",
    "num_outliers",
    "warnings",
)
"""Columns of a fix."""

TRACK_COLUMNS = (
    "track_state",
    "track_x_m",
    "track_y_m",
    "track_z_m",
    "track_vx_m_s",
    "track_vy_m_s",
    "track_vz_m_s",
    "track_horizontal_accuracy_m",
)
"""Columns of a fix with a track, besides."""

_GEOJSON_HEAD = b'{"type":"FeatureCollection","name":"rayfix fixes, metres of the scene","features":[\n'


def layout_of(path: Path) -> Layout:
    """Choose the layout by the name of the file.

    Raises
    ------
    ReportError
        When it ends in none that is known.
    """
    layout = _SUFFIXES.get(path.suffix.lower())
    if layout is None:
        raise ReportError(f"{path} cannot be written; its name has to end in {', '.join(_SUFFIXES)}")
    if layout == "parquet":
        with needs_extra("parquet"):
            import pyarrow.parquet  # noqa: F401
    return layout


def columns_of(*, track: bool) -> tuple[str, ...]:
    """Columns of CSV and Parquet, and the properties of GeoJSON."""
    return FIX_COLUMNS + TRACK_COLUMNS if track else FIX_COLUMNS


def flat(document: Mapping[str, Any]) -> dict[str, Any]:
    """Write a fix's document of a log as one row."""
    position, covariance, track = document["position"], document["covariance_m2"], document.get("track")
    used = [m for m in document["measurements"] if m["used"]]
    row = {name: document.get(name) for name in FIX_COLUMNS}
    row |= {
        "probability": document["candidates"][0]["probability"] if document["candidates"] else None,
        "num_measurements": len(document["measurements"]),
        "num_used": len(used),
        "num_outliers": sum(1 for m in used if m["outlier_probability"] > 0.5),
        "warnings": "; ".join(document.get("warnings", ())) or None,
    }
    if position is not None:
        row |= {f"{axis}_m": position[axis] for axis in "xyz"}
        upper = [covariance[i][j] for i in range(3) for j in range(i, 3)]
        row |= dict(zip(_COVARIANCE, upper, strict=True))
        row |= {f"radius_{round(100 * p)}_m": document["horizontal_radii_m"][f"{p:g}"] for p in RADII}
    if track is not None:
        row |= {f"track_{axis}_m": track["position"][axis] for axis in "xyz"}
        row |= {f"track_v{axis}_m_s": track["velocity_m_s"][axis] for axis in "xyz"}
        row |= {
            "track_state": track["state"],
            "track_horizontal_accuracy_m": track["horizontal_accuracy_m"],
        }
    return row


def head(layout: Layout, *, track: bool) -> bytes:
    """Return what a file begins with."""
    if layout == "csv":
        return (",".join(columns_of(track=track)) + "\n").encode()
    return _GEOJSON_HEAD if layout == "geojson" else b""


def tail(layout: Layout) -> bytes:
    """Return what a file ends with."""
    return b"\n]}\n" if layout == "geojson" else b""


def piece(document: Mapping[str, Any], layout: Layout, *, track: bool) -> bytes:
    """Write one fix; in GeoJSON, commas go between pieces."""
    match layout:
        case "jsonl":
            return to_json(document) + b"\n"
        case "parquet":
            return to_json(flat(document)) + b"\n"
        case "csv":
            row, text = flat(document), io.StringIO()
            values = [row.get(name) for name in columns_of(track=track)]
            csv.writer(text, lineterminator="\n").writerow(["" if value is None else value for value in values])
            return text.getvalue().encode()
        case "geojson":
            position = document["position"]
            point = None
            if position is not None:
                point = {"type": "Point", "coordinates": [position[axis] for axis in "xyz"]}
            feature = {"type": "Feature", "geometry": point, "properties": flat(document)}
            return json.dumps(feature, separators=(",", ":")).encode()


def is_fixes(path: Path, layout: Layout) -> bool:
    """Whether a file is one of fixes, or empty, so that it may be written anew."""
    with path.open("rb") as file:
        begin = file.read(200)
    marks = {
        "jsonl": (b'{"log":', b'{"x_pos', b'{"localOrigin', b'{"position_type'),
        "csv": (b"log,entry,",),
        "geojson": (b'{"type":"FeatureCollection","name":"rayfix',),
        "parquet": (b"PAR1",),
    }
    return not begin or begin.startswith(marks[layout])


def to_parquet(lines: Path, path: Path, *, track: bool, rows: int = 50_000) -> None:
    """Turn JSON lines of rows into Parquet, some at a time."""
    with needs_extra("parquet"):
        import pyarrow
        import pyarrow.parquet

    def kind(name: str) -> Any:
        if name in _TEXTS:
            return pyarrow.string()
        return pyarrow.int64() if name in _INTEGERS else pyarrow.float64()

    schema = pyarrow.schema([(name, kind(name)) for name in columns_of(track=track)])
    with lines.open("rb") as file, pyarrow.parquet.ParquetWriter(path, schema) as writer:
        for block in _blocks(file, rows):
            writer.write_table(pyarrow.Table.from_pylist(block, schema=schema))


def _blocks(file: Any, rows: int) -> Iterator[list[dict[str, Any]]]:
    block: list[dict[str, Any]] = []
    for line in file:
        block.append(json.loads(line))
        if len(block) == rows:
            yield block
            block = []
    if block:
        yield block
