"""The site file: every mistake is found, named by its path, in one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rayfix_offline.site import parse_site, read_site
from rayfix_tables.errors import SiteError
from tests.support.messages.refusals import refusal

Document = Callable[..., dict[str, Any]]


def refused(document: dict[str, Any]) -> str:
    """Check that a document is refused in one line and return that line."""
    with pytest.raises(SiteError) as caught:
        parse_site(document, source="here.toml")
    message = str(caught.value)
    assert message.startswith("here.toml: ")
    assert "\n" not in message
    return message.removeprefix("here.toml: ")


def test_the_shortest_site_has_the_documented_defaults() -> None:
    site = parse_site({"site": {"name": "a", "scene": "a.glb"}, "stations": [{"id": "s", "position_m": [1, 2, 3]}]})
    assert site.info().document == {
        "site": {"name": "a", "scene": "a.glb", "scene_unit": "m", "scene_up": "z", "north_deg": 90.0},
        "propagation": {
            "carrier_ghz": 3.5,
            "max_reflections": 3,
            "max_path_length_m": 60.0,
            "reflection": "constant",
            "reflection_loss_db": 6.0,
            "transmission": True,
            "excess_length": True,
            "path_prior": "power",
            "path_prior_exponent": 2.0,
        },
        "table": {"windows_deg": [1.25, 5.0, 15.0], "fit": "tubes", "seed": 1},
        "materials": {},
        "stations": [
            {
                "id": "s",
                "position_m": [1, 2, 3],
                "mounting": "3gpp",
                "field_of_view_deg": 360.0,
                "bias": {
                    "range_m": 0.0,
                    "range_stdev_m": 0.0,
                    "azimuth_deg": 0.0,
                    "zenith_deg": 0.0,
                    "angle_stdev_deg": 0.0,
                },
            },
        ],
    }


def test_the_table_gets_radians(site_document: Document) -> None:
    document = site_document(site={"north_deg": -30.0})
    document["stations"][0] |= {"orientation_deg": [90, 10, -45], "field_of_view_deg": 120}
    document["stations"][0]["bias"] = {"range_m": 0.2, "range_stdev_m": 0.1, "azimuth_deg": 18, "angle_stdev_deg": 9}
    site = parse_site(document)
    info = site.info()
    assert info.north == pytest.approx(-np.pi / 6, rel=1e-15)
    assert (info.name, info.max_path_length) == ("room", 30.0)
    (station,) = info.stations
    assert station.id == "bs1"
    assert station.position == (3.6, 0.4, 2.6)
    assert station.orientation == pytest.approx((np.pi / 2, np.pi / 18, -np.pi / 4), rel=1e-15)
    assert station.field_of_view == pytest.approx(2 * np.pi / 3, rel=1e-15)
    assert (station.bias.range, station.bias.range_stdev, station.bias.zenith) == (0.2, 0.1, 0.0)
    assert (station.bias.azimuth, station.bias.angle_stdev) == pytest.approx((np.pi / 10, np.pi / 20), rel=1e-15)
    assert parse_site(info.document) == site


@pytest.mark.parametrize("key", ["boresight_azimuth_deg", "boresight_downtilt_deg", "roll_deg"])
def test_an_array_is_turned_in_one_way(site_document: Document, key: str) -> None:
    document = site_document()
    document["stations"][0] |= {"orientation_deg": [90, 0, 120], key: 0.0}
    assert refused(document).startswith(
        f"stations[0]: orientation_deg and {key} both state the orientation of the array; give"
    )


def test_the_boresight_is_another_way_to_say_the_orientation(site_document: Document) -> None:
    document = site_document()
    document["stations"][0] |= {"mounting": "silabs", "boresight_downtilt_deg": 30}
    (mounted,) = parse_site(document).info().stations
    assert np.rad2deg(mounted.orientation) == pytest.approx((90, 0, 120), abs=1e-12)
    del document["stations"][0]["boresight_downtilt_deg"]
    document["stations"][0]["orientation_deg"] = [90, 0, 120]
    (turned,) = parse_site(document).info().stations
    assert (turned.mounting, turned.orientation) == ("silabs", pytest.approx(mounted.orientation, abs=1e-12))
    assert parse_site(parse_site(document).info().document) == parse_site(document)


@pytest.mark.parametrize(
    ("section", "label", "sibling"),
    [("site", "[site]", "scene_unit"), ("propagation", "[propagation]", "carrier_ghz"), ("table", "[table]", "seed")],
)
def test_an_unknown_key(site_document: Document, section: str, label: str, sibling: str) -> None:
    message = refused(site_document(**{section: {"colour": 1}}))
    assert message.startswith(f"unknown key {section}.colour; {label} knows ")
    assert sibling in message


def test_an_unknown_key_of_a_station(site_document: Document) -> None:
    document = site_document()
    document["stations"].append({"id": "bs2", "position_m": [1, 1, 1], "positon_m": [1, 1, 1]})
    expected = (
        "id, position_m, mounting, boresight_azimuth_deg, boresight_downtilt_deg, roll_deg, orientation_deg, "
        "field_of_view_deg, bias, deviations, selection"
    )
    assert refused(document) == f"unknown key stations[1].positon_m; [stations] knows {expected}"


def test_an_unknown_section(site_document: Document) -> None:
    message = refused({**site_document(), "colours": {}})
    assert message == "unknown key colours; the file knows site, room, propagation, table, materials, stations"


@pytest.mark.parametrize(("section", "key"), [("site", "name"), ("stations", "id"), ("stations", "position_m")])
def test_a_missing_key(site_document: Document, section: str, key: str) -> None:
    document = site_document()
    part = document[section]
    path = f"stations[0].{key}" if section == "stations" else f"{section}.{key}"
    del (part[0] if section == "stations" else part)[key]
    assert refused(document) == f"{path} is missing: add it"


@pytest.mark.parametrize("section", ["site", "stations"])
def test_a_missing_section(site_document: Document, section: str) -> None:
    document = site_document()
    del document[section]
    header = {"site": "[site]", "stations": "[[stations]]"}[section]
    assert refused(document) == f"{section} is missing: add a section {header}"


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("site.name", ""),
        ("site.name", 7),
        ("site.scene", ""),
        ("site.scene_unit", "yard"),
        ("site.scene_up", "x"),
        ("site.north_deg", 361),
        ("site.north_deg", float("nan")),
        ("propagation.carrier_ghz", 0),
        ("propagation.carrier_ghz", float("inf")),
        ("propagation.max_reflections", -1),
        ("propagation.max_reflections", 9),
        ("propagation.max_reflections", 1.5),
        ("propagation.max_path_length_m", 0),
        ("propagation.max_path_length_m", "long"),
        ("propagation.reflection", "ITU"),
        ("propagation.reflection_loss_db", -1),
        ("propagation.path_prior", "strong"),
        ("propagation.path_prior_exponent", float("nan")),
        ("table.windows_deg", 5.0),
        ("table.windows_deg", [0.05]),
        ("table.windows_deg", [31]),
        ("table.windows_deg", [float("nan")]),
        ("table.fit", "EM"),
        ("table.seed", -1),
        ("table.seed", 2**63),
        ("stations[0].id", ""),
        ("stations[0].id", "a/b"),
        ("stations[0].id", "../x"),
        ("stations[0].id", 1),
        ("stations[0].position_m", [1, 2]),
        ("stations[0].position_m", [1, 2, 3, 4]),
        ("stations[0].position_m", [1, float("inf"), 3]),
        ("stations[0].position_m", [1, "two", 3]),
        ("stations[0].orientation_deg", [0, 0, float("nan")]),
        ("stations[0].mounting", "ceiling"),
        ("stations[0].boresight_azimuth_deg", 361),
        ("stations[0].boresight_downtilt_deg", 91),
        ("stations[0].roll_deg", float("inf")),
        ("stations[0].field_of_view_deg", 0),
        ("stations[0].field_of_view_deg", 361),
        ("site", 5),
        ("stations", {}),
    ],
)
def test_a_value_that_does_not_fit(site_document: Document, path: str, value: Any) -> None:
    document = site_document()
    part: Any = document
    *parents, key = path.replace("[0]", ".0").split(".")
    for parent in parents:
        part = part[int(parent) if parent.isdigit() else parent]
    part[key] = value
    message = refused(document)
    assert message.startswith(path)
    # One mistake, one problem.
    assert ";" not in message


def test_nothing_of_what_there_must_be_one(site_document: Document) -> None:
    message = refused(site_document(table={"windows_deg": []}))
    assert message == "table: windows_deg must name at least one window, e.g. [1.25, 5.0, 15.0]"
    assert refused(site_document(stations=[])) == "stations must name at least one; add a [[stations]] section"


@pytest.mark.parametrize("windows", [[5.0, 5.0], [5.0, 7.4], [5.0, 1.0], [1.0, 5.0, 4.0]])
def test_windows_that_do_not_grow(site_document: Document, windows: list[float]) -> None:
    message = refused(site_document(table={"windows_deg": windows}))
    assert (
        message
        == "table: windows_deg must grow to at least 1.5 times from each window to the next, e.g. [1.25, 5.0, 15.0]"
    )


def test_stations_of_the_same_name(site_document: Document) -> None:
    stations = [{"id": name, "position_m": [1, 1, 1]} for name in ("b", "a", "b", "c", "a")]
    message = refused(site_document(stations=stations))
    assert message == "station ids must differ; more than one station is called a, b"


def test_all_problems_at_once(site_document: Document) -> None:
    document = site_document(site={"scene_up": "x", "colour": 1}, table={"seed": "one"})
    del document["stations"]
    message = refused(document)
    for part in ("site.scene_up = 'x'", "unknown key site.colour", "table.seed = 'one'", "stations is missing"):
        assert part in message


def test_a_file(tmp_path: Path, write_site: Callable[..., Path]) -> None:
    site = read_site(str(write_site(tmp_path)))
    assert site.stations[0].position_m == (3.6, 0.4, 2.6)


def file_refused(path: Path) -> str:
    """Check that a file is refused in one line that names it, and return that line."""
    return refusal(SiteError, read_site, path)


def test_a_missing_file(tmp_path: Path) -> None:
    assert "'rayfix example DIR' writes one" in file_refused(tmp_path / "none.toml")


def test_a_folder(tmp_path: Path) -> None:
    assert "give a TOML site file" in file_refused(tmp_path)


@pytest.mark.parametrize("content", [b"[site\n", b"name = \n", b"a = 1\na = 2\n"])
def test_not_toml(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "site.toml"
    path.write_bytes(content)
    assert "is not valid TOML" in file_refused(path)


def test_not_text(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_bytes(b"\x89HDF\r\n\xff\xfe")
    assert "give a TOML site file" in file_refused(path)


def test_an_empty_file(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.touch()
    message = file_refused(path)
    assert message == f"{path}: site is missing: add a section [site]; stations is missing: add a section [[stations]]"


def test_problems_of_a_file_name_it(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text('[site]\nname = "a"\nscene = "a.glb"\n')
    assert file_refused(path) == f"{path}: stations is missing: add a section [[stations]]"


def test_a_byte_order_mark(tmp_path: Path) -> None:
    text = '[site]\nname = "a"\nscene = "b.glb"\n[[stations]]\nid = "s"\nposition_m = [1, 2, 3]\n'
    (tmp_path / "plain.toml").write_text(text)
    (tmp_path / "marked.toml").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read_site(tmp_path / "marked.toml") == read_site(tmp_path / "plain.toml")


@pytest.mark.parametrize("name", [r"C:\Users\me\hall.glb", r"data\hall.glb", r"C:\temp\new.glb"])
def test_windows_paths(name: str, tmp_path: Path) -> None:
    """An escape sequence that TOML does not have, one that it lacks digits of, and two that it has."""
    text = '[site]\nname = "a"\nscene = {}\n[[stations]]\nid = "s"\nposition_m = [1, 2, 3]\n'
    (tmp_path / "site.toml").write_text(text.format(f'"{name}"'))
    assert "write Windows paths with / or in single quotes" in file_refused(tmp_path / "site.toml")
    (tmp_path / "site.toml").write_text(text.format(f"'{name}'"))
    assert read_site(tmp_path / "site.toml").site.scene == name


def test_the_drift_of_a_stations_errors_is_read(site_document: Document) -> None:
    document = site_document()
    document["stations"][0]["deviations"] = {"correlation_s": 1.5, "correlated_share": 0.6}
    found = parse_site(document).info().stations[0].deviations
    assert found is not None
    assert (found.correlation_time, found.correlated_share) == (1.5, 0.6)
    assert found.azimuth is None
