"""Positions in other systems' formats: exact ellipses by hand, probabilities by sampling, real samples."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from rayfix_service.adapters.formats import write
from rayfix_service.adapters.omlox import fix_to_omlox, utc_milliseconds
from rayfix_service.adapters.threegpp import ellipsoid_scale, fix_to_3gpp
from rayfix_service.fusion.report import Candidate, Fix, Outcome
from rayfix_service.http.examples import LOCAL_3D_EXAMPLE, OMLOX_EXAMPLE
from rayfix_service.http.outputs import Local3dPointUncertaintyEllipsoid, OmloxLocation
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo

SITE = SiteInfo(name="hall", north=math.radians(90), max_path_length=60.0, stations=())


def site(north_deg: float) -> SiteInfo:
    return SiteInfo(name="hall", north=math.radians(north_deg), max_path_length=60.0, stations=())


def a_fix(covariance: Any, *, probability: float = 1.0, **more: Any) -> Fix:
    candidate = Candidate(
        probability=probability, position=np.array([1.0, 2.0, 3.0]), covariance=np.array(covariance, dtype=float)
    )
    return Fix(status="ok", candidates=(candidate,), outcomes=(), log_evidence=0.0, table_id="id", **more)


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
        [2.0 * scale, 1.0 * scale, 0.5 * scale], rel=1e-9
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


@pytest.mark.parametrize(("probability", "confidence"), [(1.0, 68), (0.5, 34), (0.01, 1)])
def test_the_confidence_is_that_of_the_candidate_and_its_ellipsoid(probability: float, confidence: int):
    assert fix_to_3gpp(a_fix(np.eye(3), probability=probability), SITE)["confidence"] == confidence


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9), st.floats(0.05, 0.99))
def test_the_ellipsoid_holds_what_it_says(entries: Sequence[float], confidence: float):
    """Against the distribution function on a grid of directions, ten times as fine, by the other formula."""
    root = np.array(entries).reshape(3, 3) + 0.2 * np.eye(3)
    covariance = root @ root.T + 1e-4 * np.eye(3)
    scale = ellipsoid_scale(covariance, confidence)
    # z = root u s: the target is inside where s^2 u' root' D^-1 root u <= scale^2, s^2 of 3 degrees of freedom.
    upright = covariance.copy()
    upright[:2, 2] = upright[2, :2] = 0.0
    shape = np.linalg.inv(upright)
    square_root = np.linalg.cholesky(covariance)
    t, phi = np.meshgrid((np.arange(300) + 0.5) / 150 - 1, (np.arange(200) + 0.5) / 100 * math.pi)
    ring = np.sqrt(1 - t**2)
    u = np.stack([ring * np.cos(phi), ring * np.sin(phi), t]).reshape(3, -1)
    spread = np.einsum("in,ij,jn->n", square_root @ u, shape, square_root @ u)
    assert chi2.cdf(scale**2 / spread, 3).mean() == pytest.approx(confidence, abs=2e-3)


def test_without_correlation_the_ellipsoid_is_the_textbooks():
    for confidence in (0.39, 0.68, 0.95, 0.997):
        expected = math.sqrt(chi2.ppf(confidence, 3))
        assert ellipsoid_scale(np.diag([4.0, 1.0, 0.1]), confidence) == pytest.approx(expected, rel=1e-9)
    assert math.isfinite(ellipsoid_scale(np.zeros((3, 3))))


def test_an_omlox_location():
    fix = a_fix(turned(0, 0.3, 0.3, 0.2), target_id="agv-7", timestamp="2026-01-31T11:00:00.2509+01:00")
    location = fix_to_omlox(fix, SITE)
    # The radius of a circular Gaussian that holds 68 %.
    assert location.pop("accuracy") == pytest.approx(0.3 * math.sqrt(-2 * math.log(0.32)), rel=1e-9)
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
    folder = Path(__file__).resolve().parents[3] / "shared" / "formats"
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


def test_the_documents_describe_what_comes():
    fix = a_fix(np.eye(3), target_id="t", timestamp="2026-01-31T11:00:00Z")
    for model, written, example in (
        (Local3dPointUncertaintyEllipsoid, fix_to_3gpp(fix, SITE), LOCAL_3D_EXAMPLE),
        (OmloxLocation, fix_to_omlox(fix, SITE), OMLOX_EXAMPLE),
    ):
        assert model.model_validate(written).model_dump() == written
        assert model.model_validate(example).model_dump() == example
        assert example.keys() == written.keys()
