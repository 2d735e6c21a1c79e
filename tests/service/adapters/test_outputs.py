"""Positions in other systems' formats: exact ellipses by hand, probabilities by sampling, real samples."""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from rayfix_service.adapters.formats import write
from rayfix_service.adapters.omlox import fix_to_omlox
from rayfix_service.adapters.threegpp import fix_to_3gpp
from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fix import Candidate, Fix, Outcome
from rayfix_service.fusion.posterior.points import ListedPoints
from rayfix_service.http.openapi.examples import LOCAL_3D_EXAMPLE, OMLOX_EXAMPLE
from rayfix_service.http.openapi.responses import Local3dPointUncertaintyEllipsoid, OmloxLocation
from rayfix_service.measuring.timestamps import utc_milliseconds
from rayfix_service.tracking.track import Estimate, TrackedPosition
from rayfix_tables.errors import ReportError
from rayfix_tables.gaussians.normal_points import normal_points
from rayfix_tables.site import SiteInfo
from tests.support.checkout import SHARED

SITE = SiteInfo(name="hall", north=math.radians(90), max_path_length=60.0, stations=())


def site(north_deg: float) -> SiteInfo:
    return SiteInfo(name="hall", north=math.radians(north_deg), max_path_length=60.0, stations=())


def a_fix(covariance: Any, *, share: float = 1.0, **more: Any) -> Fix:
    """Fix whose posterior is one Gaussian, but for the share that everything is an outlier."""
    position, cov = np.array([1.0, 2.0, 3.0]), np.array(covariance, dtype=float)
    points = position + normal_points(1024) @ np.linalg.cholesky(cov).T
    regions = CredibleRegions(position=position, covariance=cov, points=ListedPoints(position=points), share=share)
    candidate = Candidate(probability=share, position=position, covariance=cov)
    return Fix(
        status="ok", candidates=(candidate,), outcomes=(), log_evidence=0.0, table_id="id", regions=regions, **more
    )


def turned(azimuth_deg: float, major: float, minor: float, vertical: float) -> NDArray[np.float64]:
    """Covariance of these standard deviations, its major axis turned to an azimuth."""
    a = math.radians(azimuth_deg)
    along, across = np.array([math.cos(a), math.sin(a), 0.0]), np.array([-math.sin(a), math.cos(a), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    parts = ((along, major), (across, minor), (up, vertical))
    return np.sum([np.outer(axis, axis) * stdev**2 for axis, stdev in parts], axis=0)


@pytest.mark.parametrize(
    ("azimuth_deg", "north_deg", "bearing"),
    [
        (90, 90, 0),  # along north
        (0, 90, 90),  # +x is east
        (60, 90, 30),
        (-30, 90, 120),
        (150, 90, 120),  # an axis has no direction
        (0, 0, 0),
        (10, 0, 170),
        (45, -120, 15),
    ],
)
def test_the_major_axis_is_a_bearing(azimuth_deg: float, north_deg: float, bearing: int):
    document = fix_to_3gpp(a_fix(turned(azimuth_deg, 2.0, 1.0, 0.5)), site(north_deg))
    ellipsoid = document["uncertaintyEllipsoid"]
    assert ellipsoid["orientationMajor"] == bearing
    scale = math.sqrt(chi2.ppf(0.68, 3))
    assert [ellipsoid["semiMajor"], ellipsoid["semiMinor"], ellipsoid["vertical"]] == pytest.approx(
        [2.0 * scale, 1.0 * scale, 0.5 * scale], rel=0.02
    )


@pytest.mark.parametrize(
    ("north_deg", "tenths"), [(90, 0), (0, 2700), (180, 900), (45.5, 3155), (89.99, 0), (-120, 1500)]
)
def test_the_scenes_y_axis_is_a_bearing(north_deg: float, tenths: int):
    origin = fix_to_3gpp(a_fix(np.eye(3)), site(north_deg))["localOrigin"]
    assert origin == {"coordinateId": "hall", "horizAxesOrientation": tenths}


def test_an_axis_is_never_at_180_degrees():
    document = fix_to_3gpp(a_fix(turned(-89.8, 2.0, 1.0, 0.5)), SITE)
    assert document["uncertaintyEllipsoid"]["orientationMajor"] == 0


@pytest.mark.parametrize(
    ("share", "asked", "percent"), [(1.0, 0.68, 68), (0.9, 0.68, 68), (1.0, 0.95, 95), (0.5, 0.68, 50)]
)
def test_the_confidence_is_that_of_the_ellipsoid(share: float, asked: float, percent: int):
    assert fix_to_3gpp(a_fix(np.eye(3), share=share, confidence=asked), SITE)["confidence"] == percent


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9), st.floats(0.05, 0.98))
def test_the_ellipsoid_holds_what_it_says(entries: Sequence[float], confidence: float):
    """The document's ellipsoid, put together from its bearing and semi-axes, against the Gaussian's samples."""
    root = np.array(entries).reshape(3, 3) + 0.2 * np.eye(3)
    # Not so narrow that the degree would matter.
    covariance = root @ root.T + 0.1 * np.eye(3)
    shape = fix_to_3gpp(a_fix(covariance, confidence=confidence), SITE)["uncertaintyEllipsoid"]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(3), covariance, 20_000)
    # North is +y, so that a bearing b is the azimuth 90 deg - b. It is rounded to a degree.
    bearing = math.radians(shape["orientationMajor"])
    along = np.array([math.sin(bearing), math.cos(bearing)])
    across = np.array([along[1], -along[0]])
    square = (drawn[:, :2] @ along / shape["semiMajor"]) ** 2 + (drawn[:, 2] / shape["vertical"]) ** 2
    inside = (square + (drawn[:, :2] @ across / shape["semiMinor"]) ** 2 <= 1.0).mean()
    assert inside == pytest.approx(confidence, abs=0.03)


def test_an_omlox_location():
    fix = a_fix(turned(0, 0.3, 0.3, 0.2), target_id="agv-7", timestamp="2026-01-31T11:00:00.2509+01:00")
    location = fix_to_omlox(fix, SITE)
    # The radius of a circular Gaussian that holds 68 %.
    assert location.pop("accuracy") == pytest.approx(0.3 * math.sqrt(-2 * math.log(0.32)), rel=0.02)
    properties = location.pop("properties")
    assert properties["rayfix.status"] == "ok"
    assert properties["rayfix.probability"] == 1.0
    assert location == {
        "position": {"type": "Point", "coordinates": [1.0, 2.0, 3.0]},
        "source": "hall",
        "provider_type": "unknown",
        "provider_id": "agv-7",
        "crs": "local",
        "elevation_ref": "floor",
        "floor": 0,
        "timestamp_generated": "2026-01-31T10:00:00.250Z",
    }
    anonymous = fix_to_omlox(a_fix(np.eye(3)), SITE)
    assert anonymous["provider_id"] == "unknown"
    assert "timestamp_generated" not in anonymous


def test_an_omlox_location_has_the_fields_of_real_ones():
    folder = SHARED / "formats"
    if not folder.is_dir():
        pytest.skip("the folder ../shared/formats with real samples is not here")
    full = json.loads((folder / "omlox_location_full.json").read_text(encoding="utf-8"))
    required = json.loads((folder / "omlox_location_required.json").read_text(encoding="utf-8"))
    location = fix_to_omlox(a_fix(np.eye(3), target_id="t", timestamp="2026-01-31T11:00:00Z"), SITE)
    assert required.keys() <= location.keys()
    assert location.keys() - full.keys() == {"accuracy"}
    for key in location.keys() & full.keys():
        same = (int, float) if isinstance(full[key], int | float) else type(full[key])
        assert isinstance(location[key], same), key
    assert len(location["timestamp_generated"]) == len(full["timestamp_generated"])


@pytest.mark.parametrize(
    ("text", "utc"),
    [
        ("2026-01-31T10:00:00Z", "2026-01-31T10:00:00.000Z"),
        ("2026-01-31t10:00:00.25z", "2026-01-31T10:00:00.250Z"),
        ("2026-01-31 10:00:00.1234567-05:30", "2026-01-31T15:30:00.123Z"),
        ("2016-12-31T23:59:60.5Z", "2017-01-01T00:00:00.500Z"),
    ],
)
def test_times_are_utc_with_milliseconds(text: str, utc: str):
    assert utc_milliseconds(text) == utc


@pytest.mark.parametrize("output", ["3gpp", "omlox"])
def test_without_position_there_is_nothing_to_write(output: Any):
    outcomes = (Outcome(used=False, reason="no ray comes from there"),)
    fix = Fix(status="insufficient", candidates=(), outcomes=outcomes, log_evidence=0.0, table_id="id")
    with pytest.raises(ReportError, match=r"no position .*measurements\[0\]: no ray comes from there"):
        write(fix, output, SITE, compute_seconds=0.0)
    assert write(fix, "native", SITE, compute_seconds=0.0)["position"] is None


def a_track(timestamp: str = "2026-01-31T10:00:01Z") -> TrackedPosition:
    """Make a track at (3, 4, 1) m that moves by 0.6 m/s along -x and 0.8 m/s along +y."""
    covariance = np.diag([0.04, 0.09, 0.01])
    position = np.array([3.0, 4.0, 1.0])
    found = Estimate(
        probability=0.9,
        position=position,
        covariance=covariance,
        velocity=np.array([-0.6, 0.8, 0.0]),
        velocity_covariance=0.1 * np.eye(3),
    )
    points = position + normal_points(1024) @ np.sqrt(covariance)
    regions = CredibleRegions(position=position, covariance=covariance, points=ListedPoints(position=points), share=1.0)
    return TrackedPosition(state="updated", timestamp=timestamp, num_reports=7, estimate=found, regions=regions)


@pytest.mark.parametrize(
    # A target that moves to 126.87 deg, counter-clockwise from +x.
    ("north_deg", "course"),
    [(90.0, 323.1301), (126.8699, 0.0), (0.0, 233.1301), (-90.0, 143.1301)],
)
def test_a_track_takes_the_fixs_place(north_deg: float, course: float):
    fix = a_fix(np.eye(3), target_id="t", timestamp="2026-01-31T10:00:00Z")
    location = fix_to_omlox(fix, site(north_deg), a_track())
    assert location["position"]["coordinates"] == [3.0, 4.0, 1.0]
    assert location["timestamp_generated"] == "2026-01-31T10:00:01.000Z"
    assert location["speed"] == pytest.approx(1.0)
    assert (location["course"] - course + 180.0) % 360.0 == pytest.approx(180.0, abs=1e-3)
    assert location["properties"]["rayfix.track"] == "updated"
    # 68 % of a Gaussian of 0.2 m by 0.3 m.
    assert location["accuracy"] == pytest.approx(0.384, abs=0.01)
    assert fix_to_3gpp(fix, site(north_deg), a_track())["point"] == {"x": 3.0, "y": 4.0, "z": 1.0}


def test_a_track_stands_beside_the_native_fix():
    fix = a_fix(np.eye(3), target_id="t", timestamp="2026-01-31T10:00:00Z")
    alone = write(fix, "native", SITE, compute_seconds=0.0)
    beside = write(fix, "native", SITE, compute_seconds=0.0, track=a_track())
    assert "track" not in alone
    track = beside.pop("track")
    assert beside == alone
    assert track["velocity_m_s"] == {"x": -0.6, "y": 0.8, "z": 0.0}
    assert (track["state"], track["num_reports"], track["probability"]) == ("updated", 7, 0.9)
    assert track["position"] == {"x": 3.0, "y": 4.0, "z": 1.0}
    assert track["vertical_accuracy_m"] == pytest.approx(0.0994, abs=0.004)  # 68 % of a Gaussian of 0.1 m


def test_without_a_fix_a_track_still_tells_a_position():
    fix = Fix(status="insufficient", candidates=(), outcomes=(), log_evidence=0.0, table_id="id", target_id="t")
    assert fix_to_omlox(fix, SITE, a_track())["position"]["coordinates"] == [3.0, 4.0, 1.0]


def test_the_documents_describe_what_comes():
    fix = a_fix(np.eye(3), target_id="t", timestamp="2026-01-31T11:00:00Z")
    for model, written, example in (
        (Local3dPointUncertaintyEllipsoid, fix_to_3gpp(fix, SITE), LOCAL_3D_EXAMPLE),
        (OmloxLocation, fix_to_omlox(fix, SITE), OMLOX_EXAMPLE),
    ):
        assert model.model_validate(written).model_dump(exclude_unset=True) == written
        assert model.model_validate(example).model_dump(exclude_unset=True) == example
        assert example.keys() == written.keys()
    tracked = fix_to_omlox(fix, SITE, a_track())
    assert OmloxLocation.model_validate(tracked).model_dump(exclude_unset=True) == tracked
