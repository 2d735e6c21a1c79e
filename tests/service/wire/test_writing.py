"""The JSON contract, the way back: fixes become answers, and reports documents again."""

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from rayfix_service.fusion.measurements.report import (
    Angle,
    ErrorModel,
    Height,
    LogRange,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fix import Candidate, Fix, Outcome
from rayfix_service.fusion.posterior.points import ListedPoints
from rayfix_service.http.openapi.examples import FIX_EXAMPLE, REPORT_EXAMPLES
from rayfix_service.wire import FixDocument, fix_to_document, parse_report, report_to_document
from rayfix_tables.gaussians.normal_points import normal_points

# --- fixes ------------------------------------------------------------------------------------------------


def gaussian(xx: float, xy: float, yy: float, zz: float = 1.0) -> np.ndarray:
    return np.array([[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, zz]])


def regions_of(candidate: Candidate, share: float = 1.0) -> CredibleRegions:
    """Regions of a fix whose posterior is one Gaussian, but for this share."""
    points = candidate.position + normal_points(1024) @ np.linalg.cholesky(candidate.covariance).T
    return CredibleRegions(
        position=candidate.position, covariance=candidate.covariance, points=ListedPoints(position=points), share=share
    )


@pytest.mark.parametrize(("confidence", "share"), [(0.5, 1.0), (0.68, 0.9), (0.95, 1.0), (0.95, 0.9)])
def test_the_accuracies_are_those_of_the_confidence_asked_for(confidence: float, share: float):
    candidate = Candidate(probability=0.9, position=np.array([1.0, 2.0, 0.5]), covariance=gaussian(4.0, 0.5, 2.0))
    regions = regions_of(candidate, share)
    fix = Fix(
        status="ok",
        candidates=(candidate,),
        outcomes=(),
        log_evidence=0.0,
        table_id="id",
        regions=regions,
        confidence=confidence,
    )
    document = fix_to_document(fix, 0.001)
    assert document["horizontal_accuracy_m"] == regions.horizontal_radius(confidence)
    assert document["vertical_accuracy_m"] == regions.vertical_half_height(confidence)
    axes = np.array(document["ellipsoid_semi_axes_m"])
    np.testing.assert_allclose(axes.T @ axes, regions.ellipsoid(confidence).shape, rtol=0, atol=1e-12)
    assert (np.diff(np.linalg.norm(axes, axis=1)) <= 0.0).all()
    # No region is more probable than that anything but an outlier was measured.
    assert document["confidence"] == min(confidence, share)


def test_a_fix_becomes_the_documented_answer():
    near = Candidate(probability=0.9, position=np.array([1.0, 2.0, 0.5]), covariance=gaussian(4.0, 0.0, 4.0))
    far = Candidate(probability=0.1, position=np.array([7.0, 9.0, 1.5]), covariance=np.eye(3))
    fix = Fix(
        status="ok",
        candidates=(near, far),
        outcomes=(
            Outcome(used=True, outlier_probability=0.02),
            Outcome(used=False, reason="no ray of bs1 comes from there"),
        ),
        log_evidence=-3.0,
        table_id="ab" * 32,
        regions=regions_of(near),
        target_id="agv-7",
        timestamp="2026-01-31T10:00:00.250Z",
    )
    document = json.loads(json.dumps(fix_to_document(fix, 0.0012345), allow_nan=False))
    horizontal, vertical = document.pop("horizontal_accuracy_m"), document.pop("vertical_accuracy_m")
    assert horizontal == pytest.approx(2.0 * math.sqrt(-2.0 * math.log(0.32)), rel=0.02)
    assert vertical == pytest.approx(0.994457883209753, rel=0.02)
    lengths = np.linalg.norm(document.pop("ellipsoid_semi_axes_m"), axis=1)
    np.testing.assert_allclose(lengths, math.sqrt(chi2.ppf(0.68, 3)) * np.array([2.0, 2.0, 1.0]), rtol=0.05)
    assert document == {
        "target_id": "agv-7",
        "timestamp": "2026-01-31T10:00:00.250Z",
        "status": "ok",
        "position": {"x": 1.0, "y": 2.0, "z": 0.5},
        "covariance_m2": [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]],
        "confidence": 0.68,
        "candidates": [
            {
                "probability": 0.9,
                "position": {"x": 1.0, "y": 2.0, "z": 0.5},
                "covariance_m2": [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]],
            },
            {
                "probability": 0.1,
                "position": {"x": 7.0, "y": 9.0, "z": 1.5},
                "covariance_m2": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            },
        ],
        "measurements": [
            {"index": 0, "used": True, "outlier_probability": 0.02},
            {
                "index": 1,
                "used": False,
                "outlier_probability": None,
                "reason": "no ray of bs1 comes from there",
            },
        ],
        "table_id": "ab" * 32,
        "compute_ms": 1.234,
    }


def test_a_fix_without_candidates_has_no_position():
    fix = Fix(
        status="insufficient",
        candidates=(),
        outcomes=(Outcome(used=False, reason="outside the field of view"),),
        log_evidence=0.0,
        table_id="ab" * 32,
    )
    document = fix_to_document(fix, 0.001)
    FixDocument.model_validate(document)
    assert document["status"] == "insufficient"
    assert document["candidates"] == []
    for key in (
        "position",
        "covariance_m2",
        "horizontal_accuracy_m",
        "vertical_accuracy_m",
        "ellipsoid_semi_axes_m",
        "target_id",
        "timestamp",
    ):
        assert document[key] is None


def test_answer_and_schema_have_the_same_keys():
    candidate = Candidate(probability=1.0, position=np.zeros(3), covariance=np.eye(3))
    fix = Fix(
        status="ok",
        candidates=(candidate,),
        outcomes=(Outcome(used=False, reason="x"),),
        log_evidence=0.0,
        table_id="ab" * 32,
        regions=regions_of(candidate),
    )
    document = fix_to_document(fix, 0.001)
    assert FixDocument.model_validate(document).model_dump(mode="json", exclude_unset=True) == document
    assert document.keys() == FixDocument.model_fields.keys() - {"simplified", "track", "warnings"}
    assert list(FIX_EXAMPLE) == list(document)
    FixDocument.model_validate(FIX_EXAMPLE)


# --- reports ----------------------------------------------------------------------------------------------

STATIONS = st.sampled_from(["bs1", "bs2", "bs3"])
METRES = st.floats(1e-3, 1e6)
ERROR_MODELS = st.one_of(
    st.just(ErrorModel()), st.builds(ErrorModel, tail_share=st.floats(1e-3, 0.5), tail_scale=st.floats(1.5, 20))
)
SIGHTS = st.none() | st.floats(0.0, 1.0)
SINGLE_ANGLES = st.builds(
    Angle,
    station_id=STATIONS,
    azimuth=st.floats(-3.14, 3.14),
    azimuth_stdev=st.floats(1e-6, 6.0),
    frame=st.sampled_from(["scene", "lcs", "north"]),
    error_model=ERROR_MODELS,
    los_probability=SIGHTS,
)
FULL_ANGLES = st.builds(
    Angle,
    station_id=STATIONS,
    azimuth=st.floats(-3.14, 3.14),
    azimuth_stdev=st.floats(1e-6, 6.0),
    zenith=st.floats(0.0, 3.14),
    zenith_stdev=st.floats(1e-6, 6.0),
    correlation=st.floats(-0.99, 0.99),
)
LENGTHS = st.one_of(
    *(
        st.builds(
            kind,
            station_id=STATIONS,
            path_length=METRES,
            stdev=METRES,
            error_model=ERROR_MODELS,
            los_probability=SIGHTS,
        )
        for kind in (Range, TimeOfArrival)
    )
)
LOG_RANGES = st.builds(LogRange, station_id=STATIONS, path_length=st.floats(0.01, 1e4), log_stdev=st.floats(0.02, 1.4))
DIFFERENCES = st.builds(
    TimeDifference,
    station_id=STATIONS,
    reference_station_id=st.just("bs4"),
    length_difference=st.floats(-1e6, 1e6),
    stdev=METRES,
)


@given(
    measurements=st.lists(
        st.one_of(SINGLE_ANGLES, FULL_ANGLES, LENGTHS, LOG_RANGES, DIFFERENCES), min_size=1, max_size=4
    ),
    height=st.none() | st.builds(Height, z=st.floats(-100, 100), stdev=st.floats(1e-3, 100)),
    confidence=st.floats(0.01, 0.99),
    target_id=st.none() | st.text(max_size=9),
)
def test_a_report_comes_back_from_its_document(
    measurements: list[Any], height: Height | None, confidence: float, target_id: str | None
):
    report = Report(
        measurements=tuple(measurements),
        height=height,
        confidence=confidence,
        target_id=target_id,
        timestamp="2026-01-31T10:00:00Z",
    )
    again = parse_report(json.dumps(report_to_document(report)).encode())
    assert (again.height, again.confidence, again.target_id, again.timestamp) == (
        height,
        confidence,
        target_id,
        report.timestamp,
    )
    for before, after in zip(report.measurements, again.measurements, strict=True):
        assert type(after) is type(before)
        for field in dataclasses.fields(before):
            value = getattr(before, field.name)
            expected = pytest.approx(value, rel=1e-9, abs=1e-13) if isinstance(value, float) else value
            assert getattr(after, field.name) == expected


@pytest.mark.parametrize("name", ["angle_and_time", "angles"])
def test_a_document_in_metres_and_degrees_is_itself_again(name: str):
    document = REPORT_EXAMPLES[name]["value"]
    assert report_to_document(parse_report(document)) == document
