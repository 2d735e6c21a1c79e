"""The site as stored in a table: stations, north, and the settings of the build."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Mounting = Literal["3gpp", "silabs", "ublox"]
"""Local frame of an array, by who defines it; :mod:`rayfix_tables.geometry.mounting` has their axes."""


Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class AngleBias:
    """Bias of a station's angles that depends on the direction; between the directions of the grid it is interpolated.

    Beyond the grid it is that of the nearest edge.

    Attributes
    ----------
    azimuths, zeniths : tuple of float, rad
        The grid, ascending: true directions, in the frame in which the station reports them.
    azimuth, zenith : tuple of tuples of float, rad
        Biases, measured minus true, a row for each zenith.
    azimuth_stdev, zenith_stdev : tuple of tuples of float, rad
        Their standard deviations.
    """

    azimuths: tuple[float, ...]
    zeniths: tuple[float, ...]
    azimuth: Rows
    zenith: Rows
    azimuth_stdev: Rows
    zenith_stdev: Rows


@dataclass(frozen=True, kw_only=True)
class Deviations:
    """Errors of a station's measurements as a calibration found them; the fusion takes them instead of the stated ones.

    Attributes
    ----------
    azimuth, zenith : float or None, rad
        Standard deviations of angles; None leaves those that reports state.
    range : float or None, m
        Of times as lengths.
    tail_share, tail_scale : float
        Of heavy tails, as in an error model of a report; they go with the deviations.
    correlation_time : float or None, s
        Time in which the correlation of the errors' drift falls to 37 %.
    correlated_share : float or None
        Of the variance that belongs to the drift; None where the calibration did not tell.
    """

    azimuth: float | None = None
    zenith: float | None = None
    range: float | None = None
    tail_share: float = 0.0
    tail_scale: float = 1.0
    correlation_time: float | None = None
    correlated_share: float | None = None


@dataclass(frozen=True, kw_only=True)
class StationBias:
    """Systematic error of a station: measured minus true. The fusion subtracts it; the table does not depend on it.

    Attributes
    ----------
    range, range_stdev : float, m
        Bias of times as lengths (propagation times, times of arrival and their differences), and its standard
        deviation.
    azimuth, zenith : float, rad
        Biases of the angles, in the frame in which the station reports them.
    angle_stdev : float, rad
        Standard deviation of each of these two.
    angles : AngleBias, optional
        What depends on the direction; it comes on top.
    """

    range: float = 0.0
    range_stdev: float = 0.0
    azimuth: float = 0.0
    zenith: float = 0.0
    angle_stdev: float = 0.0
    angles: AngleBias | None = None


NO_BIAS = StationBias()

Rule = Literal["strongest", "first", "any", "all"]
"""Which of the paths that it hears a station reports."""

REACH_DB: dict[Rule, float] = {"strongest": 40.0, "first": 30.0, "any": 40.0, "all": 20.0}
"""By how much an audible path may be weaker than all together where nothing else is said."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The rule by which a station selects the paths that it reports.

    Attributes
    ----------
    rule : {"strongest", "first", "any", "all"}
        The strongest path, the earliest audible one, any audible one alike, or all audible ones.
    exponent : float
        Of "strongest": a path is reported with a probability in proportion to its gain to this power.
    within_db : float, optional
        Paths that are weaker than all paths to a place together by less than this are audible; ``REACH_DB`` by default.
    """

    rule: Rule
    exponent: float = 2.0
    within_db: float | None = None

    @property
    def reach_db(self) -> float:
        """By how much an audible path may be weaker than all together."""
        return REACH_DB[self.rule] if self.within_db is None else self.within_db


@dataclass(frozen=True, kw_only=True)
class Station:
    """A base station, anchor or locator.

    Attributes
    ----------
    position : tuple of 3 floats, m
        In the scene frame.
    orientation : tuple of 3 floats, rad
        Bearing, downtilt and slant, as in 3GPP TR 38.901; they rotate the scene frame into the station's local one.
    field_of_view : float, rad
        Full opening angle of the cone around the station's boresight in which it measures.
    bias : StationBias
    mounting : {"3gpp", "silabs", "ublox"}
        Which axes of the local frame are the array's boresight and upper edge.
    deviations : Deviations, optional
    selection : Selection, optional
        Rule by which it selects what it reports; the one that the table was built with by default.
    """

    id: str
    position: tuple[float, float, float]
    orientation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    field_of_view: float = 6.283185307179586
    bias: StationBias = NO_BIAS
    mounting: Mounting = "3gpp"
    deviations: Deviations | None = None
    selection: Selection | None = None

    def moved(self, by: NDArray[np.float64]) -> "Station":
        """Return the station translated by a vector of shape (3,), m."""
        x, y, z = (np.asarray(self.position) + by).tolist()
        return replace(self, position=(x, y, z))


@dataclass(frozen=True, kw_only=True)
class SiteInfo:
    """The site as stored in a table.

    Attributes
    ----------
    north : float, rad
        Azimuth of geographic north in the scene frame.
    max_path_length : float, m
        Largest unfolded path length in the table.
    document : dict
        The whole site file, validated, as JSON-compatible data.
    """

    name: str
    north: float
    max_path_length: float
    stations: tuple[Station, ...]
    document: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def has_deviations(self) -> bool:
        """Whether a calibration has found the deviations of a station."""
        return any(station.deviations is not None for station in self.stations)

    @cached_property
    def station_by_id(self) -> Mapping[str, Station]:
        """The stations by their identifiers."""
        return {station.id: station for station in self.stations}
