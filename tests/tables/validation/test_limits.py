"""Ranges of settings."""

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np
import pytest

from rayfix.client.retries import RetryPolicy
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.tracking.drift import DriftModel
from rayfix_service.tracking.motion import MotionModel
from rayfix_service.tracking.settings import TrackingSettings
from rayfix_tables.errors import RayfixError, SettingsError
from rayfix_tables.validation.limits import Limits, _limited_fields, check_limits

SETTINGS = [FusionSettings, TrackingSettings, MotionModel, DriftModel, RetryPolicy]
WITHOUT_LIMITS = {"motion", "drift"}


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One field of each kind."""

    share: Annotated[float, Limits(above=0.0, below=1.0)] = 0.5
    count: Annotated[int, Limits(least=1, most=9)] = 3
    name: str = ""


@pytest.mark.parametrize("value", [0.0, 1.0, -0.1, 1.1, math.nan, math.inf, -math.inf, "0.5", None, True, 0.5j])
def test_what_is_out_of_range_is_named_with_its_range(value: Any):
    with pytest.raises(SettingsError) as found:
        check_limits(Sample(share=value))
    assert str(found.value) == f"Sample: share is {value!r}; give a finite number above 0 and below 1"
    assert isinstance(found.value, RayfixError)
    assert isinstance(found.value, ValueError)


@pytest.mark.parametrize("value", [0, 10, 1.0, math.nan, True])
def test_a_count_is_a_whole_number(value: Any):
    with pytest.raises(SettingsError, match="give a whole number at least 1 and at most 9"):
        check_limits(Sample(count=value))


@pytest.mark.parametrize(("share", "count"), [(1e-300, 1), (np.float64(0.25), np.int32(9)), (1.0 - 1e-16, 5)])
def test_what_is_within_its_range_is_taken(share: float, count: int):
    check_limits(Sample(share=share, count=count))


@pytest.mark.parametrize("kind", SETTINGS)
def test_every_setting_is_checked(kind: type):
    limited = {name: limits for name, _, limits in _limited_fields(kind)}
    assert set(limited) == {field.name for field in fields(kind)} - WITHOUT_LIMITS
    kind()
    for name in limited:
        for wrong in (math.nan, -1, -1.5, "1"):
            with pytest.raises(SettingsError, match=rf"{kind.__name__}: {name} is"):
                kind(**{name: wrong})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("outlier_probability", 0.0),
        ("outlier_probability", 1.0),
        ("sight_error", 0.6),
        ("beam_width", 0),
        ("component_floor", 0.0),
        ("hypothesis_floor", 1.0),
        ("ambiguous_below", 1.5),
        ("most_rivals", 0),
        ("insufficient_above", 0.0),
    ],
)
def test_the_fusion_refuses_what_it_cannot_work_with(name: str, value: float):
    with pytest.raises(SettingsError, match=rf"FusionSettings: {name} is {value}; give a "):
        FusionSettings(**{name: value})
