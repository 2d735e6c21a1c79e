"""Logs of every layout give the same reports; what is none is named and passed over."""

import gzip
import json
import math
from pathlib import Path
from typing import Any

import pytest

from rayfix.logs.csv_logs import CsvColumns
from rayfix.logs.entries import Entry, Place, Problem
from rayfix.logs.reading import Reading, ReadState, read_logs
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.wire import parse_report
from rayfix_tables.errors import ReportError


def document(n: int, **more: Any) -> dict[str, Any]:
    return {
        "target_id": f"tag {n % 2}",
        "timestamp": f"2026-01-31T10:00:{n // 2:02d}.500Z",
        "measurements": [{"type": "pt", "station_id": "bs1", "range_m": 5.0 + n, "stdev_m": 0.1}],
        **more,
    }


def found(path: Path, reading: Reading | None = None) -> tuple[list[Report], list[Problem]]:
    entries = list(read_logs([path], reading or Reading()))
    reports = [
        parse_report(e.report) if isinstance(e.report, bytes) else e.report for e in entries if isinstance(e, Entry)
    ]
    return reports, [e for e in entries if isinstance(e, Problem)]


DOCUMENTS = [document(n, **({"height": {"z_m": 1.0, "stdev_m": 0.1}} if n == 3 else {})) for n in range(7)]
REPORTS = [parse_report(each) for each in DOCUMENTS]
LINES = "\n".join(json.dumps(each) for each in DOCUMENTS)

LAYOUTS = {
    "lines": LINES,
    "lines, blank ones and a byte order mark": "\ufeff" + LINES.replace("\n", "\n\n  \r\n") + "\n",
    "array": json.dumps(DOCUMENTS, indent=1),
    "batch": json.dumps({"reports": DOCUMENTS}),
    "batch over lines": "\ufeff\n" + json.dumps({"reports": DOCUMENTS}, indent=3) + "\n",
}


PATHS = """target_id;timestamp;station_id;azimuth_deg;elevation_deg;toa_m;power_db;stdev_m
a;2026-01-31T10:00:00Z;bs1;10;-20;131.5;-60;0.3
a;2026-01-31T10:00:00Z;bs1;14;-22;133.0;-66;0.3
a;2026-01-31T10:00:00Z;bs2;;;129.0;;0.3
a;2026-01-31T10:00:01Z;bs1;11;-20;140.0;-61;0.3
"""


@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gzip"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_json_of_every_layout(tmp_path: Path, layout: str, zipped: bool) -> None:
    content = LAYOUTS[layout].encode()
    path = tmp_path / "log"
    path.write_bytes(gzip.compress(content) if zipped else content)
    assert found(path) == (REPORTS, [])


def test_one_report_over_many_lines(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text(json.dumps(DOCUMENTS[3], indent=2), encoding="utf-8")
    assert found(path) == ([REPORTS[3]], [])


@pytest.mark.parametrize("padding", [0, 1, 2, 3, 5])
def test_elements_and_characters_that_chunks_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, padding: int) -> None:
    monkeypatch.setattr("rayfix.logs.json_logs._CHUNK", 7)
    path = tmp_path / "log.json"
    documents = [document(0, target_id="Gerät € 🛰" + "x" * padding), *DOCUMENTS]
    path.write_text(json.dumps({"reports": documents}, ensure_ascii=False), encoding="utf-8")
    assert found(path) == ([parse_report(each) for each in documents], [])


def test_bad_lines_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    lines = LINES.splitlines()
    path.write_text("\n".join([lines[0], "{oops", lines[1], "x" * (1 << 21), lines[2]]), encoding="utf-8")
    entries = list(read_logs([path], Reading()))
    assert [e.place.entry for e in entries] == [1, 2, 3, 4, 5]
    assert [isinstance(e, Problem) for e in entries] == [False, False, False, True, False]
    assert isinstance(entries[3], Problem)
    assert "split it" in entries[3].text


def test_an_array_that_breaks_gives_what_comes_before(tmp_path: Path) -> None:
    path = tmp_path / "log.json"
    text = json.dumps(DOCUMENTS)
    path.write_text(text[: text.index("tag 1")], encoding="utf-8")
    reports, problems = found(path)
    assert reports == REPORTS[:1]
    assert [p.place for p in problems] == [Place("log.json", 2)]
    path.write_text(json.dumps({"reports": DOCUMENTS[:2], "more": 1}), encoding="utf-8")
    reports, problems = found(path)
    assert reports == REPORTS[:2]
    assert "not read" in problems[0].text


def test_a_gzip_file_that_ends_early_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.gz"
    path.write_bytes(gzip.compress(LINES.encode())[:-20])
    with pytest.raises(ReportError, match="is the file complete"):
        found(path)


CSV = """time,tag,anchor,az,el,channel
1769853600250,a,A1,10,20,37
1769853600250,a,bs2,-170,-5,38
1769853600750,a,A1,12,x,37
1769853601250,a,A1,14,20,37
1769853601250,a,A1,14
"""


def test_csv_with_columns_of_other_names(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(CSV, encoding="utf-8")
    names = {
        "timestamp_ms": "time",
        "target_id": "tag",
        "station_id": "anchor",
        "azimuth_clockwise_deg": "az",
        "elevation_deg": "el",
    }
    values = {
        "azimuth_stdev_deg": "5",
        "zenith_stdev_deg": "6",
        "frame": "lcs",
        "height_z_m": "1",
        "height_stdev_m": "0.1",
    }
    reading = Reading(columns=CsvColumns(names=names, values=values), stations={"A1": "bs1"})
    state = ReadState()
    entries = list(read_logs([path], reading, state))
    assert state.unread_columns == ["channel"]
    assert state.num_bytes == path.stat().st_size
    reports = [e.report for e in entries if isinstance(e, Entry)]
    problems = [e for e in entries if isinstance(e, Problem)]
    assert [p.place.entry for p in problems] == [4, 6]
    assert "elevation_deg is 'x'" in problems[0].text
    assert "5 fields" not in problems[1].text
    assert "4 fields" in problems[1].text
    first, second = reports
    assert isinstance(first, Report)
    assert isinstance(second, Report)
    assert (first.target_id, first.timestamp) == ("a", "2026-01-31T10:00:00.250000Z")
    assert first.height is not None
    assert first.height.z == 1.0
    one, other = first.measurements
    assert isinstance(one, Angle)
    assert isinstance(other, Angle)
    assert (one.station_id, other.station_id) == ("bs1", "bs2")
    # Clockwise becomes counter-clockwise, an elevation the angle from above.
    assert math.degrees(one.azimuth) == pytest.approx(-10.0, abs=1e-12)
    assert one.zenith is not None
    assert math.degrees(one.zenith) == pytest.approx(70.0, abs=1e-12)
    assert math.degrees(other.azimuth) == pytest.approx(170.0, abs=1e-12)
    assert (one.frame, round(math.degrees(one.azimuth_stdev), 9)) == ("lcs", 5.0)


def test_csv_rows_of_types_and_reports(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "report;type;station_id;azimuth_deg;azimuth_stdev_deg;range_m;stdev_m\n"
        "1;aoa;bs1;10;1;;\n1;pt;bs1;;;5.5;0.1\n2;pt;bs2;;;4;0.1\n2;pt;bs1;10;;4;0.1\n",
        encoding="utf-8",
    )
    reports, problems = found(path)
    assert [[type(m) for m in r.measurements] for r in reports] == [[Angle, Range], [Range]]
    # Of a row with a type all columns count: this one has an azimuth that is none of a propagation time.
    assert "azimuth_deg" in problems[0].text


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        ("a,b\n1,2\n", CsvColumns(), "has no column that is read"),
        ("azimuth_deg\n1\n", CsvColumns(names={"station_id": "anchor"}), "no column 'anchor' for station_id"),
        (LINES, CsvColumns(names={"station_id": "anchor"}), "are for logs in CSV"),
        ('+UUDF:6C1DEBA5F60C,-53,15,-6,0,37,"bs1","",1437347,40871\n', CsvColumns(), "--format ublox"),
    ],
)
def test_logs_of_another_kind_are_refused(tmp_path: Path, text: str, columns: CsvColumns, message: str) -> None:
    path = tmp_path / "log"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ReportError, match=message):
        found(path, Reading(columns=columns))


def uudf(n: int, anchor: str, azimuth: int, *, before: str = "") -> str:
    return f'{before}+UUDF:TAG,-53,{azimuth},-6,0,37,"{anchor}","",1437347,{n}'


@pytest.mark.parametrize("stated", [{}, {"type": "path"}], ids=["told by columns", "type given"])
def test_csv_with_a_row_for_each_path(tmp_path: Path, stated: dict[str, str]) -> None:
    """Rows of one target and time are the paths of one report; a time alone is a path as well."""
    path = tmp_path / "paths.csv"
    rows = PATHS.splitlines()
    if stated:  # where the type says it, a row may not have deviations of angles that it has not
        rows = [row for row in rows if ";bs2;" not in row]
    path.write_text("\n".join(rows), encoding="utf-8")
    values = {"azimuth_stdev_deg": "1", "zenith_stdev_deg": "2", **stated}
    reports, problems = found(path, Reading(columns=CsvColumns(values=values)))
    assert problems == []
    angles = {"azimuth_stdev_deg": 1.0, "zenith_stdev_deg": 2.0, "stdev_m": 0.3}
    expected = [
        {"station_id": "bs1", "azimuth_deg": 10.0, "zenith_deg": 110.0, "toa_m": 131.5, "power_db": -60.0, **angles},
        {"station_id": "bs1", "azimuth_deg": 14.0, "zenith_deg": 112.0, "toa_m": 133.0, "power_db": -66.0, **angles},
        {"station_id": "bs2", "toa_m": 129.0, "stdev_m": 0.3},
    ]
    first = parse_report(
        {
            "target_id": "a",
            "timestamp": "2026-01-31T10:00:00Z",
            "measurements": [{"type": "path", **each} for each in expected[: 2 if stated else 3]],
        }
    )
    assert reports[0] == first
    assert len(reports) == 2
    assert len(reports[1].measurements) == 1


def test_ublox_lines_by_their_packets(tmp_path: Path) -> None:
    path = tmp_path / "anchors.log"
    lines = [
        uudf(n, anchor, 10 * n, before=f"2026-01-31 10:00:{n:02d}.000 ")
        for n in range(5)
        for anchor in (("A", "B") if n != 2 else ("B",))
    ]
    lines.insert(3, "garbage")
    path.write_text("\n".join(lines), encoding="utf-8")
    reports, problems = found(path, Reading(input_format="ublox", stations={"A": "bs1"}))
    assert [[m.station_id for m in r.measurements] for r in reports] == [["bs1", "B"]] * 2 + [["B"]] + [
        ["bs1", "B"]
    ] * 2
    assert [r.timestamp for r in reports] == [f"2026-01-31T10:00:{n:02d}+00:00" for n in range(5)]
    assert [p.place.entry for p in problems] == [4]


def test_silabs_lines_with_topics_and_packets_as_json(tmp_path: Path) -> None:
    angle = {"azimuth": 15.0, "azimuth_stdev": 1.2, "elevation": -6.0, "elevation_stdev": 1.1, "sequence": 7}
    topics = tmp_path / "topics.log"
    topics.write_text(
        "".join(f"1769853600.25 silabs/aoa/angle/L{n}/tag {json.dumps(angle)}\n" for n in (1, 2)), encoding="utf-8"
    )
    reading = Reading(input_format="silabs", stations={"L1": "bs1"})
    (report,), problems = found(topics, reading)
    assert problems == []
    assert [m.station_id for m in report.measurements] == ["bs1", "L2"]
    assert (report.target_id, report.timestamp) == ("tag", "2026-01-31T10:00:00.250000+00:00")
    packets = tmp_path / "packets.jsonl"
    packet = {"target_id": "tag", "angles": [{"locator_id": f"L{n}", **angle} for n in (1, 2)]}
    packets.write_text(json.dumps(packet) + "\n" + json.dumps({"angles": []}) + "\n", encoding="utf-8")
    (same,), problems = found(packets, reading)
    assert same.measurements == report.measurements
    assert len(problems) == 1
