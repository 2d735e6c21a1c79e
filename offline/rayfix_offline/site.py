"""The site file: scene, propagation, table settings and stations."""

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from rayfix_offline.site_sections import AngleBiasSection, DeviationsSection, RoomSection, Section, SelectionSection
from rayfix_tables.errors import SiteError
from rayfix_tables.geometry.mounting import Boresight, boresight_of, orientation_of
from rayfix_tables.site import Mounting, SiteInfo, Station, StationBias
from rayfix_tables.validation.problems import path_text

OFF_WALL = 1e-3
"""Metres that a station on a wall of a room is moved off it: rays that begin in a wall would be lost."""

MIN_WINDOW_RATIO = 1.5
"""Smallest ratio of a window to the one before: its cells are sums of finer cells, which must add up to its window."""

LARGEST_COORDINATE = 5e7
"""m; maps have coordinates of up to 2e7 m, and far beyond, single precision cannot distinguish walls."""

WINDOWS_PATH = "write Windows paths with / or in single quotes; in double quotes, \\ begins an escape sequence"

Finite = Annotated[float, Field(allow_inf_nan=False)]
Coordinate = Annotated[float, Field(ge=-LARGEST_COORDINATE, le=LARGEST_COORDINATE)]
Triple = tuple[Finite, Finite, Finite]

_BORESIGHT_KEYS = ("boresight_azimuth_deg", "boresight_downtilt_deg", "roll_deg")


class SiteSection(Section):
    """``[site]``: the scene and how to read it."""

    name: Annotated[str, Field(min_length=1, max_length=100)] = Field(
        description="name of the site; answers give it as their source"
    )
    scene: Annotated[str, Field(min_length=1)] | None = Field(
        default=None,
        description="scene file, relative to the site file: glb, gltf, obj, ply, stl, dae, Mitsuba XML or IFC; "
        "left out where there is a section [room]",
        json_schema_extra={"effect": "time and size grow with the number of objects: see Large sites"},
    )
    scene_unit: Literal["m", "cm", "mm", "in", "ft"] = Field(
        default="m", description="unit of the scene file, if the file does not state one"
    )
    scene_up: Literal["z", "y"] = Field(
        default="z",
        description="axis of the scene file that points up, y in most glTF files; COLLADA and IFC files state it",
    )
    north_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=90.0,
        description="azimuth of geographic north in the scene frame, for angles of the frame north and bearings",
        json_schema_extra={"effect": "nothing is built again"},
    )

    @field_validator("scene")
    @classmethod
    def _no_escapes(cls, scene: str | None) -> str | None:
        if scene is not None and any(
            ord(letter) < 32 for letter in scene
        ):  # "C:\temp\new.glb" has a tab and a new line
            raise ValueError(f"{scene!r} is not a file name: {WINDOWS_PATH}")
        return scene


class PropagationSection(Section):
    """``[propagation]``: the paths, and which of them a station reports."""

    carrier_ghz: Annotated[float, Field(gt=0, le=1000)] = Field(
        default=3.5,
        description="carrier frequency, for the materials of reflection = itu",
        json_schema_extra={"effect": "time and size stay the same"},
    )
    max_reflections: Annotated[int, Field(ge=0, le=8)] = Field(
        default=3,
        description="largest number of reflections of a path",
        json_schema_extra={"effect": "time and size grow with each reflection"},
    )
    max_path_length_m: Annotated[float, Field(gt=0, le=10_000)] = Field(
        default=60.0,
        description="largest length of a path; at least the diagonal of the hall",
        json_schema_extra={"effect": "time and size grow with it, as long as rays reach that far"},
    )
    reflection: Literal["constant", "itu"] = Field(
        default="constant",
        description="reflection loss: constant, or computed from the material names by ITU-R P.2040",
        json_schema_extra={"effect": "time and size stay the same"},
    )
    reflection_loss_db: Annotated[float, Field(ge=0, le=100)] = Field(
        default=6.0,
        description="loss of each reflection; with itu, for materials without a known name",
        json_schema_extra={"effect": "time and size stay the same"},
    )
    transmission: bool = Field(
        default=True,
        description="whether walls of known material and thickness let signals through",
        json_schema_extra={"effect": "time and size grow where walls let signals through: see Walls"},
    )
    excess_length: bool = Field(
        default=True,
        description="whether a wall that a path passes adds to its measured length, as a slab of its permittivity does",
        json_schema_extra={"effect": "time and size stay the same"},
    )
    path_prior: Literal["power", "uniform", "paper"] = Field(
        default="power",
        description="path-selection prior: strong paths preferred, any path alike, or as in the paper",
        json_schema_extra={
            "effect": "with power the probabilities are normalised at the end of the build, which takes some time"
        },
    )
    path_prior_exponent: Annotated[float, Field(ge=0, le=20)] = Field(
        default=2.0,
        description="exponent of the path gain in the path-selection prior; a larger one prefers strong paths more",
        json_schema_extra={"effect": "time and size stay the same"},
    )


class MaterialSection(Section):
    """``[materials.NAME]``: a material of the scene, by the name that the scene file gives it."""

    itu: str | None = Field(
        default=None,
        description="material of ITU-R P.2040, e.g. plasterboard; NAME itself unless given",
    )
    permittivity: Annotated[float, Field(ge=1, le=1000)] | None = Field(
        default=None, description="real part of the relative permittivity, instead of itu"
    )
    conductivity_s_m: Annotated[float, Field(ge=0, le=1e9)] | None = Field(
        default=None, description="conductivity, with permittivity; 0 unless given"
    )
    reflection_loss_db: Annotated[float, Field(ge=0, le=200)] | None = Field(
        default=None, description="loss of each reflection, instead of the computed one"
    )
    transmission_loss_db: Annotated[float, Field(ge=0, le=200)] | None = Field(
        default=None, description="loss of each passage through a wall, instead of the computed one"
    )
    thickness_m: Annotated[float, Field(gt=0, le=100)] | None = Field(
        default=None,
        description="thickness of sheets; a closed solid has its own, but lets signals through only with this key",
        json_schema_extra={"effect": "time and size grow where walls let signals through: see Walls"},
    )

    @model_validator(mode="after")
    def _made_of_one(self) -> "MaterialSection":
        if self.itu is not None and self.permittivity is not None:
            raise ValueError("itu and permittivity both state the material; give one of them")
        if self.conductivity_s_m is not None and self.permittivity is None:
            raise ValueError("conductivity_s_m needs permittivity; add it, or give itu instead")
        return self


class TableSection(Section):
    """``[table]``: windows and fit of the table."""

    windows_deg: tuple[Annotated[float, Field(ge=0.1, le=30)], ...] = Field(
        default=(1.25, 5.0, 15.0),
        description="standard deviations of the windows of angles, each at least 1.5 times the one before",
        json_schema_extra={"effect": "decides time and size: see below"},
    )
    fit: Literal["tubes", "em"] = Field(
        default="tubes",
        description="method of fitting a cell: ray tubes, or the paper's expectation-maximisation",
        json_schema_extra={"effect": "em takes several hundred times as long"},
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(
        default=1,
        description="seed of the random offsets of the rays",
        json_schema_extra={"effect": "time and size stay the same"},
    )

    @model_validator(mode="after")
    def _windows_ascend(self) -> "TableSection":
        if not self.windows_deg:
            raise ValueError("windows_deg must name at least one window, e.g. [1.25, 5.0, 15.0]")
        if any(b < MIN_WINDOW_RATIO * a for a, b in zip(self.windows_deg, self.windows_deg[1:], strict=False)):
            raise ValueError(
                f"windows_deg must grow to at least {MIN_WINDOW_RATIO:g} times from each window to the next, "
                "e.g. [1.25, 5.0, 15.0]"
            )
        return self


class BiasSection(Section):
    """``[stations.bias]``: systematic errors of a station, measured minus true."""

    range_m: Annotated[float, Field(ge=-10_000, le=10_000)] = Field(
        default=0.0, description="bias of propagation times as lengths, measured minus true"
    )
    range_stdev_m: Annotated[float, Field(ge=0, le=10_000)] = Field(
        default=0.0, description="standard deviation of the range bias"
    )
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=0.0, description="bias of azimuths, in the frame in which the station reports them"
    )
    zenith_deg: Annotated[float, Field(ge=-90, le=90)] = Field(
        default=0.0, description="bias of zenith angles, in the same frame"
    )
    angle_stdev_deg: Annotated[float, Field(ge=0, le=90)] = Field(
        default=0.0, description="standard deviation of the azimuth bias and of the zenith bias"
    )
    angles: AngleBiasSection | None = Field(
        default=None, description="what depends on the direction, and comes on top: a table with a grid"
    )


class StationSection(Section):
    """``[[stations]]``: one base station, anchor or locator."""

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.:-]{0,63}$")] = Field(
        description="name that reports use: 1 to 64 letters, digits or . _ : -",
        json_schema_extra={"effect": "a new name builds the station again"},
    )
    position_m: tuple[Coordinate, Coordinate, Coordinate] = Field(
        description="position of the antenna in the scene frame: x, y, z",
        json_schema_extra={"effect": "the station is built again"},
    )
    mounting: Mounting = Field(
        default="3gpp",
        description="local frame of the array: which of its axes are the boresight and the upper edge",
        json_schema_extra={"effect": "as that of boresight_azimuth_deg"},
    )
    boresight_azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None = Field(
        default=None,
        description="azimuth of the boresight, counter-clockwise from +x of the scene; 0 unless given",
        json_schema_extra={
            "effect": "with a field of view of 360 deg nothing is built again, else the cells that come into view"
        },
    )
    boresight_downtilt_deg: Annotated[float, Field(ge=-90, le=90)] | None = Field(
        default=None,
        description="angle of the boresight below the horizon; 0 unless given",
        json_schema_extra={"effect": "as that of boresight_azimuth_deg"},
    )
    roll_deg: Annotated[float, Field(ge=-360, le=360)] | None = Field(
        default=None,
        description="rotation about the boresight, clockwise when looking along it; 0 unless given",
        json_schema_extra={"effect": "nothing is built again"},
    )
    orientation_deg: Triple | None = Field(
        default=None,
        description="bearing, downtilt and slant of 3GPP TR 38.901, instead of the three keys above",
        json_schema_extra={"effect": "as that of boresight_azimuth_deg"},
    )
    field_of_view_deg: Annotated[float, Field(gt=0, le=360)] = Field(
        default=360.0,
        description="full opening angle of the cone around the boresight in which the station measures",
        json_schema_extra={"effect": "time and size are those of the cells within it"},
    )
    bias: BiasSection = Field(
        default=BiasSection(),
        description="systematic errors of the station: a table with the keys below",
        json_schema_extra={"effect": "nothing is built again"},
    )
    deviations: DeviationsSection | None = Field(
        default=None,
        description="errors of its measurements, taken instead of what reports state: a table with the keys below",
        json_schema_extra={"effect": "nothing is built again"},
    )
    selection: SelectionSection | None = Field(
        default=None,
        description="which of its paths it reports, if not by path_prior: a table with the keys below",
        json_schema_extra={"effect": "nothing is built again"},
    )

    @model_validator(mode="after")
    def _turned_once(self) -> "StationSection":
        given = [key for key in _BORESIGHT_KEYS if getattr(self, key) is not None]
        if given and self.orientation_deg is not None:
            raise ValueError(
                f"orientation_deg and {', '.join(given)} both state the orientation of the array; give one of them: "
                "the boresight, or the orientation of 3GPP TR 38.901"
            )
        return self

    def station(self) -> Station:
        """Return the station as the table stores it."""
        if self.orientation_deg is None:
            azimuth, downtilt, roll = (float(np.deg2rad(getattr(self, key) or 0.0)) for key in _BORESIGHT_KEYS)
            orientation = orientation_of(self.mounting, Boresight(azimuth, downtilt), roll)
        else:
            orientation = _radians(self.orientation_deg)
        bias = self.bias
        return Station(
            id=self.id,
            position=self.position_m,
            orientation=orientation,
            field_of_view=float(np.deg2rad(self.field_of_view_deg)),
            bias=StationBias(
                range=bias.range_m,
                range_stdev=bias.range_stdev_m,
                azimuth=float(np.deg2rad(bias.azimuth_deg)),
                zenith=float(np.deg2rad(bias.zenith_deg)),
                angle_stdev=float(np.deg2rad(bias.angle_stdev_deg)),
                angles=None if bias.angles is None else bias.angles.angle_bias(),
            ),
            mounting=self.mounting,
            deviations=None if self.deviations is None else self.deviations.deviations(),
            selection=None if self.selection is None else self.selection.selection(),
        )

    def built_from(self) -> dict[str, Any]:
        """Return what the station's part of the table depends on: position and field of view.

        The fusion subtracts the bias and turns the angles. So the orientation matters only if the field of view is
        limited, and then only by the boresight: it is returned as the orientation of a frame with the boresight as x
        axis.
        """
        looks = [0.0, 0.0, 0.0]
        if self.field_of_view_deg < 360.0:
            looks = [*(round(float(angle), 9) for angle in np.rad2deg(boresight_of(self.station()))), 0.0]
        return {
            "id": self.id,
            "position_m": list(self.position_m),
            "orientation_deg": looks,
            "field_of_view_deg": self.field_of_view_deg,
        }


class SiteFile(Section):
    """A whole site file."""

    site: SiteSection
    room: RoomSection | None = None
    propagation: PropagationSection = PropagationSection()
    table: TableSection = TableSection()
    materials: dict[Annotated[str, Field(min_length=1)], MaterialSection] = Field(default_factory=dict)
    stations: tuple[StationSection, ...]

    @model_validator(mode="after")
    def _ids_differ(self) -> "SiteFile":
        ids = [station.id for station in self.stations]
        if not ids:
            raise ValueError("stations must name at least one; add a [[stations]] section")
        twice = sorted({i for i in ids if ids.count(i) > 1})
        if twice:
            raise ValueError(f"station ids must differ; more than one station is called {', '.join(twice)}")
        return self

    @model_validator(mode="after")
    def _one_scene(self) -> "SiteFile":
        if self.site.scene is None and self.room is None:
            raise ValueError("site.scene is missing: add it, or a section [room] for an empty room")
        if self.site.scene is not None and self.room is not None:
            raise ValueError("site.scene and [room] both say what the scene is; give one of them")
        return self

    def moved(self, by: NDArray[np.float64]) -> "SiteFile":
        """Return the site with its stations translated by a vector of shape (3,), m."""
        if not np.any(by):
            return self
        stations = tuple(
            station.model_copy(update={"position_m": tuple((np.asarray(station.position_m) + by).tolist())})
            for station in self.stations
        )
        return self.model_copy(update={"stations": stations})

    def off_walls(self) -> "SiteFile":
        """Return the site with the stations that stand on walls of its room moved off them, by a millimetre."""
        if self.room is None:
            return self
        size = np.asarray(self.room.size_m)
        stations = []
        for station in self.stations:
            position = np.asarray(station.position_m)
            inside = np.clip(position, OFF_WALL, size - OFF_WALL)
            if 0.0 < np.abs(inside - position).max() <= 1.001 * OFF_WALL:
                station = station.model_copy(update={"position_m": tuple(inside.tolist())})
            stations.append(station)
        return self.model_copy(update={"stations": tuple(stations)})

    def info(self) -> SiteInfo:
        """Return the site as the table stores it."""
        return SiteInfo(
            name=self.site.name,
            north=float(np.deg2rad(self.site.north_deg)),
            max_path_length=self.propagation.max_path_length_m,
            stations=tuple(section.station() for section in self.stations),
            document=self.model_dump(mode="json", exclude_none=True),
        )


def read_site(path: str | Path) -> SiteFile:
    """Read and validate a site file.

    Raises
    ------
    SiteError
        When the file is missing, is not TOML, or is not valid; the message names every offending key.
    """
    path = Path(path)
    try:
        # Some editors write a byte order mark first.
        document = tomllib.loads(path.read_text(encoding="utf-8").removeprefix("\ufeff"))
    except FileNotFoundError:
        raise SiteError(f"there is no site file at {path}; 'rayfix example DIR' writes one to start from") from None
    except OSError as error:
        raise SiteError(f"{path} cannot be read ({error.strerror}); give a TOML site file") from error
    except UnicodeDecodeError as error:
        raise SiteError(f"{path} is not UTF-8 text; {_wanted(path)}") from error
    except tomllib.TOMLDecodeError as error:
        remedy = _hint(error) if path.suffix.lower() == ".toml" else f"; {_wanted(path)}"
        raise SiteError(f"{path} is not valid TOML: {error}{remedy}") from error
    return parse_site(document, source=str(path))


def _wanted(path: Path) -> str:
    """Say what to give, if it was a scene perhaps."""
    if path.suffix.lower() == ".toml":
        return "give a TOML site file"
    return f'give a TOML site file; one for this scene has [site] scene = "{path.name}", and stations'


def _hint(error: tomllib.TOMLDecodeError) -> str:
    """Explain how to write a Windows path, if the error is that of one in double quotes."""
    if re.search(r"escape|hex value", str(error), re.IGNORECASE) is None:
        return ""
    return f"; {WINDOWS_PATH}"


def parse_site(document: dict[str, Any], *, source: str = "site") -> SiteFile:
    """Validate the content of a site file.

    Parameters
    ----------
    source : str
        Name of the file in messages.

    Raises
    ------
    SiteError
        When it is not valid; the message names every offending key.
    """
    try:
        return SiteFile.model_validate(document).off_walls()
    except ValidationError as error:
        problems = "; ".join(_problem(e) for e in error.errors())
        raise SiteError(f"{source}: {problems}") from error


def _problem(error: Any) -> str:
    key = path_text(error["loc"])
    if error["type"] == "extra_forbidden":
        section = ".".join(str(part) for part in error["loc"][:-1] if isinstance(part, str))
        known = _known_keys(error["loc"][:-1])
        return f"unknown key {key}; {f'[{section}]' if section else 'the file'} knows {', '.join(known)}"
    if error["type"] == "missing":
        return f"{key} is missing: {_what_to_add(error['loc'])}"
    if error["type"] == "string_pattern_mismatch":
        return f"{key} = {error['input']!r}: give 1 to 64 letters, digits or . _ : -, a letter or digit first"
    if error["type"] == "tuple_type":
        return f"{key} = {error['input']!r}: give a list of numbers, as [7.0, 5.0, 2.5]"
    message = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key} = {error['input']!r}: {message[0].lower()}{message[1:]}"


def _what_to_add(location: tuple[str | int, ...]) -> str:
    if isinstance(location[-1], int):
        return "give three numbers"
    if len(location) > 1:
        return "add it"
    return f"add a section {'[[stations]]' if location[0] == 'stations' else f'[{location[0]}]'}"


def _known_keys(location: tuple[str | int, ...]) -> list[str]:
    model: type[BaseModel] = SiteFile
    sections: dict[str, type[BaseModel]] = {
        "site": SiteSection,
        "room": RoomSection,
        "propagation": PropagationSection,
        "table": TableSection,
        "materials": MaterialSection,
        "stations": StationSection,
        "bias": BiasSection,
        "angles": AngleBiasSection,
        "deviations": DeviationsSection,
        "selection": SelectionSection,
    }
    for part in location:
        if isinstance(part, str) and part in sections:
            model = sections[part]
    return list(model.model_fields)


def _radians(degrees: Triple) -> Triple:
    a, b, c = (float(v) for v in np.deg2rad(degrees))
    return (a, b, c)
