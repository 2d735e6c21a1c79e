"""The request documents: what a report looks like as JSON."""

from typing import Self

from pydantic import ConfigDict, Field, model_validator

from rayfix_service.fusion.measurements.report import CONFIDENCE, Height
from rayfix_service.wire.fields import (
    Confidence,
    HeightM,
    HeightStdevM,
    Rfc3339,
    SelectionExponent,
    WireModel,
    WithinDb,
    misfit,
)
from rayfix_service.wire.measurements import MeasurementDocument
from rayfix_tables.site import Rule, Selection

MAX_MEASUREMENTS = 256
"""Measurements that one report may have."""

MAX_REPORTS = 1000
"""Reports that one batch may have."""


class HeightDocument(WireModel):
    """What is known of the target's height beforehand, for example that it lies on a trolley."""

    model_config = ConfigDict(title="Height")

    z_m: HeightM
    stdev_m: HeightStdevM

    def height(self) -> Height:
        """Convert."""
        return Height(z=self.z_m, stdev=self.stdev_m)


class SelectionDocument(WireModel):
    """Which of the paths that they hear the stations of a report reported."""

    model_config = ConfigDict(title="Selection")

    rule: Rule = Field(
        description='one of "strongest", "first" (the earliest audible path), "any" (each audible path alike) and "all"'
    )
    exponent: SelectionExponent | None = None
    within_db: WithinDb | None = None

    @model_validator(mode="after")
    def _exponent_of_strongest(self) -> Self:
        if self.exponent is not None and self.rule != "strongest":
            raise misfit("exponent", 'is of the rule "strongest"; leave it out')
        if self.within_db is not None and self.rule == "strongest":
            raise misfit("within_db", 'is not of the rule "strongest"; leave it out')
        return self

    def selection(self) -> Selection:
        """Convert."""
        exponent = Selection.exponent if self.exponent is None else self.exponent
        return Selection(rule=self.rule, exponent=exponent, within_db=self.within_db)


class ReportDocument(WireModel):
    """The measurements of one transmission."""

    model_config = ConfigDict(title="Report")

    target_id: str | None = Field(
        default=None,
        max_length=256,
        description="your name for the target, a text of at most 256 characters, sent back as it is",
    )
    timestamp: Rfc3339 | None = Field(
        default=None,
        max_length=64,
        description='an RFC 3339 date-time such as "2026-01-31T10:00:00.250Z", sent back as it is',
        json_schema_extra={"format": "date-time"},
    )
    height: HeightDocument | None = Field(
        default=None, description='an object such as {"z_m": 1.2, "stdev_m": 0.1}: the known height of the target'
    )
    confidence: Confidence = CONFIDENCE
    selection: SelectionDocument | None = Field(
        default=None,
        description='an object such as {"rule": "first"}: which of their paths the stations report, if not by the '
        "rule of the site",
    )
    measurements: list[MeasurementDocument] = Field(
        strict=False,  # a tuple is as good, where the document comes from Python
        min_length=1,
        max_length=MAX_MEASUREMENTS,
        description=f"an array of 1 to {MAX_MEASUREMENTS} measurements",
    )


class BatchDocument(WireModel):
    """Many reports, answered in their order.

    This is for the OpenAPI document: a batch is never validated as a whole, since one bad report must not
    cost the others their fix.
    """

    model_config = ConfigDict(title="Batch")

    reports: list[ReportDocument] = Field(
        max_length=MAX_REPORTS, description=f"an array of at most {MAX_REPORTS} reports"
    )
