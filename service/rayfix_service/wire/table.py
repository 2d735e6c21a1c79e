"""A table and its stations as JSON."""

import math
from typing import Annotated

from pydantic import BaseModel, Field

from rayfix_service.wire.points import Point
from rayfix_tables.geometry.mounting import boresight_of
from rayfix_tables.level import Level
from rayfix_tables.site import NO_BIAS, Deviations, Mounting, Station
from rayfix_tables.table import Table


class SiteSummary(BaseModel):
    """The site that the table was built for."""

    name: str
    north_deg: float = Field(description="azimuth of geographic north in the scene frame")
    max_path_length_m: float = Field(description="longest unfolded path in the table")


class TableSummary(BaseModel):
    """A table that answers."""

    name: str = Field(description="name of its file without the suffix; for the query parameter table")
    table_id: str = Field(description="SHA-256 of the table's content")
    format_version: int
    software_version: str = Field(description="version of rayfix that built the table")
    site: SiteSummary
    origin_m: Annotated[list[float], Field(min_length=3, max_length=3)] = Field(
        description="where coordinates in the table's file count from, in the scene frame; answers are in the latter"
    )
    num_stations: int
    num_components: int = Field(description="Gaussian components over all stations and levels")


class LevelSummary(BaseModel):
    """All cells of a station at one angular window."""

    window_deg: float
    num_cells: int
    num_components: int


class OrientationSummary(BaseModel):
    """Orientation of a station, as in 3GPP TR 38.901."""

    bearing_deg: float
    downtilt_deg: float
    slant_deg: float


class BoresightSummary(BaseModel):
    """Where a station's array looks."""

    azimuth_deg: float = Field(description="in the scene frame")
    downtilt_deg: float = Field(description="below the horizon")


class AngleBiasSummary(BaseModel):
    """Biases of angles that depend on the direction, linear between the directions of a grid."""

    azimuths_deg: list[float] = Field(
        description="of the grid, ascending; true directions, in the frame of the reports"
    )
    zeniths_deg: list[float]
    azimuth_deg: list[list[float]] = Field(description="measured minus true, a row for each zenith")
    zenith_deg: list[list[float]]


class CalibrationSummary(BaseModel):
    """What a calibration has found of a station; fixes take it into account."""

    range_m: float = Field(description="bias of ranges, measured minus true")
    azimuth_deg: float = Field(description="bias of azimuths, in the frame of the reports")
    zenith_deg: float = Field(description="bias of zenith angles")
    angles: AngleBiasSummary | None = Field(description="biases that depend on the direction, on top")
    azimuth_stdev_deg: float | None = Field(description="standard deviation that counts instead of the stated one")
    zenith_stdev_deg: float | None
    range_stdev_m: float | None


class StationSummary(BaseModel):
    """A station and its part of the table."""

    id: str
    position: Point
    orientation: OrientationSummary
    mounting: Mounting = Field(description="which axes of its local frame are the boresight and the upper edge")
    boresight: BoresightSummary
    field_of_view_deg: float = Field(
        description="full opening angle of the cone around the boresight that it measures in"
    )
    levels: list[LevelSummary] = Field(description="finest first")
    calibration: CalibrationSummary | None = Field(description="null where the site file states none")


def table_summary(name: str, table: Table) -> TableSummary:
    """Describe a table."""
    stations = table.site.stations
    return TableSummary(
        name=name,
        table_id=table.table_id,
        format_version=table.format_version,
        software_version=table.software_version,
        site=SiteSummary(
            name=table.site.name,
            north_deg=_degrees(table.site.north),
            max_path_length_m=table.site.max_path_length,
        ),
        origin_m=table.scene.origin.tolist(),
        num_stations=len(stations),
        num_components=sum(level.num_components for s in stations for level in table.levels(s.id)),
    )


def station_summary(station: Station, levels: tuple[Level, ...]) -> StationSummary:
    """Describe a station and its levels."""
    x, y, z = station.position
    bearing, downtilt, slant = (_degrees(angle) for angle in station.orientation)
    boresight = boresight_of(station)
    return StationSummary(
        id=station.id,
        position=Point(x=x, y=y, z=z),
        orientation=OrientationSummary(bearing_deg=bearing, downtilt_deg=downtilt, slant_deg=slant),
        mounting=station.mounting,
        boresight=BoresightSummary(azimuth_deg=_degrees(boresight.azimuth), downtilt_deg=_degrees(boresight.downtilt)),
        field_of_view_deg=_degrees(station.field_of_view),
        levels=[
            LevelSummary(
                window_deg=_degrees(level.window),
                num_cells=level.num_cells,
                num_components=level.num_components,
            )
            for level in levels
        ],
        calibration=_calibration(station),
    )


def _calibration(station: Station) -> CalibrationSummary | None:
    bias, found = station.bias, station.deviations or Deviations()
    if bias == NO_BIAS and found == Deviations():
        return None
    angles = None
    if bias.angles is not None:
        angles = AngleBiasSummary(
            azimuths_deg=[_degrees(v) for v in bias.angles.azimuths],
            zeniths_deg=[_degrees(v) for v in bias.angles.zeniths],
            azimuth_deg=[[_degrees(v) for v in row] for row in bias.angles.azimuth],
            zenith_deg=[[_degrees(v) for v in row] for row in bias.angles.zenith],
        )
    return CalibrationSummary(
        range_m=bias.range,
        azimuth_deg=_degrees(bias.azimuth),
        zenith_deg=_degrees(bias.zenith),
        angles=angles,
        azimuth_stdev_deg=None if found.azimuth is None else _degrees(found.azimuth),
        zenith_stdev_deg=None if found.zenith is None else _degrees(found.zenith),
        range_stdev_m=found.range,
    )


def _degrees(radians: float) -> float:
    """Convert to degrees, without the last digits that the way through radians cost."""
    return round(math.degrees(radians), 9)
