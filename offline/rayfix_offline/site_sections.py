"""Sections of the site file on rooms without a mesh, and on what a calibration has found."""

from itertools import pairwise
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rayfix_tables.site import AngleBias, Deviations, Rule, Selection


class Section(BaseModel):
    """Base of the sections: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Side = Annotated[float, Field(ge=0.5, le=10_000)]
MaterialName = Annotated[str, Field(min_length=1, max_length=100)]


class RoomSection(Section):
    """``[room]``: an empty room instead of a scene file, from the origin to its far upper corner."""

    size_m: tuple[Side, Side, Side] = Field(description="lengths along x, y and z; the room begins at the origin")
    walls: MaterialName | None = Field(default=None, description="material of the walls; none has the constant loss")
    floor: MaterialName | None = Field(default=None, description="material of the floor")
    ceiling: MaterialName | None = Field(default=None, description="material of the ceiling")


Grid = tuple[tuple[Annotated[float, Field(ge=-180, le=180)], ...], ...]
Spreads = tuple[tuple[Annotated[float, Field(ge=0, le=180)], ...], ...]


class AngleBiasSection(Section):
    """``[stations.bias.angles]``: biases that depend on the direction, as ``rayfix calibrate`` writes them."""

    azimuths_deg: tuple[Annotated[float, Field(ge=-360, le=360)], ...] = Field(
        min_length=1, max_length=40, description="azimuths of the grid, ascending, in the frame of the reports"
    )
    zeniths_deg: tuple[Annotated[float, Field(ge=0, le=180)], ...] = Field(
        min_length=1, max_length=20, description="zenith angles of the grid, ascending"
    )
    azimuth_deg: Grid = Field(description="bias of azimuths at each direction of the grid, a row for each zenith")
    zenith_deg: Grid = Field(description="bias of zenith angles, likewise")
    azimuth_stdev_deg: Spreads = Field(description="standard deviation of these biases of azimuths")
    zenith_stdev_deg: Spreads = Field(description="standard deviation of those of zenith angles")

    @model_validator(mode="after")
    def _is_grid(self) -> "AngleBiasSection":
        shape = len(self.zeniths_deg), len(self.azimuths_deg)
        for name in ("azimuth_deg", "zenith_deg", "azimuth_stdev_deg", "zenith_stdev_deg"):
            rows = getattr(self, name)
            if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
                raise ValueError(f"{name} must have {shape[0]} rows of {shape[1]} numbers, as the grid has")
        for name in ("azimuths_deg", "zeniths_deg"):
            axis = getattr(self, name)
            if any(b <= a for a, b in pairwise(axis)):
                raise ValueError(f"{name} must ascend")
        return self

    def angle_bias(self) -> AngleBias:
        """Return the bias as the table stores it."""
        return AngleBias(
            azimuths=_row(self.azimuths_deg),
            zeniths=_row(self.zeniths_deg),
            azimuth=tuple(map(_row, self.azimuth_deg)),
            zenith=tuple(map(_row, self.zenith_deg)),
            azimuth_stdev=tuple(map(_row, self.azimuth_stdev_deg)),
            zenith_stdev=tuple(map(_row, self.zenith_stdev_deg)),
        )


class DeviationsSection(Section):
    """``[stations.deviations]``: errors of a station's measurements, taken instead of what reports state."""

    azimuth_deg: Annotated[float, Field(ge=1e-3, le=180)] | None = Field(
        default=None, description="standard deviation of azimuths"
    )
    zenith_deg: Annotated[float, Field(ge=1e-3, le=180)] | None = Field(
        default=None, description="standard deviation of zenith angles"
    )
    range_m: Annotated[float, Field(ge=1e-4, le=10_000)] | None = Field(
        default=None, description="standard deviation of propagation times and times of arrival as lengths"
    )
    tail_share: Annotated[float, Field(ge=0, le=0.5)] = Field(
        default=0.0, description="probability that an error is of a wider Gaussian"
    )
    tail_scale: Annotated[float, Field(ge=1, le=20)] = Field(default=1.0, description="how many times wider that is")
    correlation_s: Annotated[float, Field(gt=0, le=1e6)] | None = Field(
        default=None,
        description="time in which the correlation of the errors' drift falls to 37 %; tracks take it into account",
    )
    correlated_share: Annotated[float, Field(ge=0, le=1)] | None = Field(
        default=None,
        description="share of the drift in the variance of the errors; without it tracks assume defaults",
    )

    def deviations(self) -> Deviations:
        """Return the deviations as the table stores them."""
        return Deviations(
            azimuth=None if self.azimuth_deg is None else float(np.deg2rad(self.azimuth_deg)),
            zenith=None if self.zenith_deg is None else float(np.deg2rad(self.zenith_deg)),
            range=self.range_m,
            tail_share=self.tail_share,
            tail_scale=self.tail_scale,
            correlation_time=self.correlation_s,
            correlated_share=self.correlated_share,
        )


class SelectionSection(Section):
    """``[stations.selection]``: which of the paths that it hears a station reports."""

    rule: Rule = Field(
        description="strongest, first (the earliest audible path), any (each audible path alike) or all (audible ones)"
    )
    exponent: Annotated[float, Field(ge=0, le=20)] = Field(
        default=2.0, description="of strongest: how much the strong paths are preferred, as path_prior_exponent"
    )
    within_db: Annotated[float, Field(gt=0, le=100)] | None = Field(
        default=None,
        description="how much weaker than all paths together an audible one may be; 30 for first, 40 for any, 20 for "
        "all unless given",
    )

    def selection(self) -> Selection:
        """Return the rule as the table stores it."""
        return Selection(rule=self.rule, exponent=self.exponent, within_db=self.within_db)


def _row(degrees: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(float(v) for v in np.deg2rad(degrees))
