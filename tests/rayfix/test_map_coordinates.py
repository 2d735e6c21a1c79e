"""A site on map coordinates is the same site elsewhere: checked, built and located in without a shift by hand.

::

    y = 10 +---------------+      seen from above: a room of 8 x 10 x 3 m with a pillar that reaches from the floor to
           |               |      2.2 m, once next to the origin and once at (500000, 5400000, 300)
           |       UE      |
           |  []           |
     y = 0 +---------------+
         x = 0             8
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import rayfix
from rayfix.cli import main
from rayfix_offline.build import build_table
from rayfix_offline.check import check_site
from rayfix_tables.table import Table
from tests.support.running.running_app import RunningApp
from tests.support.scenes.map_site import POSITIONS, SHIFT, UE, report, write_site

Array = NDArray[np.float64]

MILLIMETRE = 1e-3


class Sites(NamedTuple):
    """Paths of the site files, and of their tables beside them."""

    near: Path
    far: Path


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> Sites:
    """Build the table of the site here and there. Do not change them."""
    folder = tmp_path_factory.mktemp("map")
    found = Sites(write_site(folder / "near", np.zeros(3)), write_site(folder / "far", SHIFT))
    for path in found:
        build_table(path, path.with_suffix(".h5"), jobs=1)
    return found


@pytest.fixture(scope="module")
def near(sites: Sites) -> Table:
    return Table.open(sites.near.with_suffix(".h5"))


@pytest.fixture(scope="module")
def far(sites: Sites) -> Table:
    return Table.open(sites.far.with_suffix(".h5"))


@pytest.fixture(scope="module")
def service(sites: Sites) -> Iterator[RunningApp]:
    """Serve the far table."""
    with RunningApp(sites.far.with_suffix(".h5"), simulation=True) as app:
        yield app


def vector(point: dict[str, float]) -> Array:
    return np.array([point["x"], point["y"], point["z"]])


def test_the_check_finds_nothing(sites: Sites) -> None:
    here, there = check_site(sites.near), check_site(sites.far)
    assert here.findings == there.findings == ()
    assert there.twin.scene.sha256 != here.twin.scene.sha256  # its frame begins in the middle of the room
    np.testing.assert_array_equal(there.twin.origin, (500_004.0, 5_400_005.0, 302.0))
    assert not here.twin.origin.any()


def test_findings_are_in_the_coordinates_of_the_files(sites: Sites, tmp_path: Path) -> None:
    path = write_site(tmp_path / "site", SHIFT)
    path.write_text(path.read_text().replace("500000.3, 5400000.4, 302.6", "500002.5, 5400003.5, 301.0"))
    (finding,) = check_site(path).findings
    assert "station 'a' at (500002.5, 5400003.5, 301) m lies inside the solid 'pillar'" in finding.problem
    path.write_text(path.read_text().replace("500002.5, 5400003.5, 301.0", "500020.0, 5400003.5, 301.0"))
    (finding,) = check_site(path).findings
    assert "spans (500000, 5400000, 300) to (500008, 5400010, 303) m" in finding.problem


def test_a_table_has_the_coordinates_of_its_files(near: Table, far: Table) -> None:
    np.testing.assert_array_equal(far.scene.vertices, near.scene.vertices + SHIFT)
    for here, there in zip(near.site.stations, far.site.stations, strict=True):
        np.testing.assert_allclose(np.subtract(there.position, here.position), SHIFT, rtol=0, atol=1e-9)
    assert np.abs(far.levels("a")[0].mixture.x_mean).max() < 10.0
    assert far.scene.free_space.contains(UE + SHIFT)
    assert near.scene.free_space.volume == far.scene.free_space.volume


@pytest.mark.parametrize("height", [None, 1.35])
def test_fixes_are_moved_by_the_shift(near: Table, far: Table, height: float | None) -> None:
    here = rayfix.Locator(near).locate(report(height=height))
    there = rayfix.Locator(far).locate(report(height=None if height is None else height + SHIFT[2]))
    assert here.position is not None
    assert there.position is not None
    np.testing.assert_allclose(there.position - SHIFT, here.position, rtol=0, atol=MILLIMETRE)
    np.testing.assert_allclose(here.position, UE, rtol=0, atol=0.15)
    assert there.status == here.status == "ok"
    assert here.regions is not None
    assert there.regions is not None
    for one, other in zip(there.regions.accuracies(0.9)[:2], here.regions.accuracies(0.9)[:2], strict=True):
        assert one == pytest.approx(other, rel=0.02)
    np.testing.assert_allclose(there.regions.ellipsoid(0.9).centre, there.position, rtol=0, atol=1e-8)
    np.testing.assert_allclose(there.regions.points.places().mean(axis=0), there.position, rtol=0, atol=0.05)


def test_a_height_in_other_coordinates_is_refused(far: Table) -> None:
    with pytest.raises(rayfix.ReportError, match=r"free space lies from 300\.00 to 303\.00 m"):
        rayfix.Locator(far).locate(report(height=1.3))


def test_posteriors_are_moved_by_the_shift(near: Table, far: Table) -> None:
    here = rayfix.Locator(near).posterior(report(height=1.35))
    there = rayfix.Locator(far).posterior(report(height=1.35 + SHIFT[2]))
    points = UE + np.array([[0.0, 0.0, 0.0], [0.1, -0.05, 0.02], [90.0, 0.0, 0.0]])
    np.testing.assert_allclose(there.log_density(points + SHIFT), here.log_density(points), rtol=0, atol=0.02)
    drawn = there.sample(500, np.random.default_rng(1))
    np.testing.assert_allclose(drawn.mean(axis=0) - SHIFT, UE, rtol=0, atol=0.15)
    assert far.scene.free_space.contains(drawn).all()
    assert there.prior.eta / there.prior.precision == pytest.approx(301.35, abs=1e-6)


def test_tracks_are_moved_by_the_shift(near: Table, far: Table) -> None:
    tracked = []
    for table in (near, far):
        locator, tracker = rayfix.Locator(table), rayfix.Tracker(table)
        for second in range(6):
            told = report(np.add(UE, (0.0, 0.3 * second, 0.0)), target_id="t", timestamp=f"2026-01-01T00:00:0{second}Z")
            found = tracker.follow(locator.fuse(told))
        assert found is not None
        assert found.state == "updated"
        tracked.append(found)
    here, there = tracked
    expected = np.add(UE, (0.0, 1.5, 0.0))
    np.testing.assert_allclose(here.estimate.position, expected, rtol=0, atol=0.15)
    np.testing.assert_allclose(there.estimate.position - SHIFT, expected, rtol=0, atol=0.15)
    np.testing.assert_allclose(there.estimate.velocity, here.estimate.velocity, rtol=0, atol=0.1)
    np.testing.assert_allclose(there.regions.position, there.estimate.position, rtol=0, atol=0)


def test_the_command_line(sites: Sites, near: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = str(sites.far.with_suffix(".h5"))
    (tmp_path / "report.json").write_text(json.dumps(report()))
    assert main(["locate", table, str(tmp_path / "report.json"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    here = rayfix.Locator(near).locate(report()).position
    np.testing.assert_allclose(vector(found["position"]) - SHIFT, here, rtol=0, atol=MILLIMETRE)
    assert main(["info", table, "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    assert info["origin_m"] == [500_004.0, 5_400_005.0, 302.0]
    assert info["stations"][0]["position_m"] == pytest.approx([500_000.3, 5_400_000.4, 302.6], rel=0, abs=1e-6)
    assert main(["info", table]) == 0
    text = capsys.readouterr().out
    assert "500000.3, 5400000.4, 302.6" in text
    assert "(500004, 5400005, 302) m" in text
    assert main(["plan", table, "-o", str(tmp_path / "m.png"), "--height", "301.3", "--spacing-m", "4", "--json"]) == 0
    squares = json.loads(capsys.readouterr().out)["map"]
    places = np.array([vector(square["position"]) for square in squares])
    assert np.all((places > SHIFT) & (places < np.add(SHIFT, (8, 10, 3))))
    assert max(square["error_m"] for square in squares) < 1.0


def test_the_service(service: RunningApp, near: Table) -> None:
    here = rayfix.Locator(near).locate(report()).position
    found = service.post("/v1/positions", report()).json()
    np.testing.assert_allclose(vector(found["position"]) - SHIFT, here, rtol=0, atol=MILLIMETRE)
    for output, read in (
        ("omlox", lambda document: np.array(document["position"]["coordinates"])),
        ("3gpp", lambda document: vector(document["point"])),
    ):
        written = service.post(f"/v1/positions?output={output}", report()).json()
        np.testing.assert_allclose(read(written) - SHIFT, here, rtol=0, atol=MILLIMETRE, err_msg=output)
    tracked = service.post("/v1/positions?track=true", report(target_id="t", timestamp="2026-01-01T00:00:00Z")).json()[
        "track"
    ]
    np.testing.assert_allclose(vector(tracked["position"]) - SHIFT, UE, rtol=0, atol=0.2)


def glb_of(content: bytes) -> tuple[dict[str, Any], Array]:
    """Document of a binary glTF and the vertices of its mesh in the frame of the root node."""
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    accessor = document["accessors"][0]
    vertices = np.frombuffer(content, "<f4", 3 * accessor["count"], 20 + length + 8).reshape(-1, 3)
    return document, vertices.astype(np.float64) + document["nodes"][1]["translation"]


def test_what_the_viewer_shows(service: RunningApp, far: Table) -> None:
    document, vertices = glb_of(service.get("/v1/scene.glb").content)
    np.testing.assert_allclose(vertices, far.scene.vertices, rtol=0, atol=1e-5)
    assert document["asset"]["extras"]["origin_m"] == [500_004.0, 5_400_005.0, 301.5]
    stations = service.get("/v1/stations").json()["stations"]
    np.testing.assert_allclose(vector(stations[0]["position"]), SHIFT + POSITIONS["a"], rtol=0, atol=1e-6)
    assert service.get("/v1/table").json()["origin_m"] == [500_004.0, 5_400_005.0, 302.0]
    apart = UE - POSITIONS["a"]
    angles = {
        "azimuth_deg": np.rad2deg(np.arctan2(apart[1], apart[0])),
        "zenith_deg": np.rad2deg(np.arccos(apart[2] / np.linalg.norm(apart))),
    }
    query = "&".join(f"{key}={value:.6f}" for key, value in angles.items())
    mixture = service.get(f"/v1/stations/a/mixture?{query}&stdev_deg=1").json()
    places = np.array([vector(component["position"]) for component in mixture["components"]])
    assert np.abs(places - SHIFT - UE).max() < 30.0
    posterior = service.post("/v1/posteriors", report()).json()
    samples = np.array(posterior["samples"])
    np.testing.assert_allclose(samples.mean(axis=0) - SHIFT, UE, rtol=0, atol=0.2)
    best = max(posterior["gaussians"], key=lambda gaussian: gaussian["probability"])
    np.testing.assert_allclose(vector(best["position"]) - SHIFT, UE, rtol=0, atol=0.2)
    simulated = service.post("/v1/simulations", {"position": (UE + SHIFT).tolist(), "angle_stdev_deg": 0.5}).json()
    np.testing.assert_allclose(vector(simulated["fix"]["position"]) - SHIFT, UE, rtol=0, atol=0.3)
    assert service.post("/v1/simulations", {"position": UE.tolist()}).status_code == httpx.codes.UNPROCESSABLE_ENTITY


def test_a_build_takes_over_what_was_there(sites: Sites, tmp_path: Path) -> None:
    former = sites.far.with_suffix(".h5")
    summary = build_table(sites.far, tmp_path / "again.h5", jobs=1, former=former)
    assert {station.origin for station in summary.stations} == {"kept"}
    assert summary.table_id == Table.open(former).table_id
