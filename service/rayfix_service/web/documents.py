"""JSON models of the viewer's routes."""

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rayfix_service.fusion.posterior.posterior import Posterior
from rayfix_service.web.inspector import DirectionView
from rayfix_service.web.simulation import SimulatedPath
from rayfix_service.wire import (
    FixDocument,
    Point,
    ReportDocument,
    WireModel,
    read_json,
)
from rayfix_service.wire.points import Matrix
from rayfix_service.wire.problems import invalid_report


class ViewerSettings(BaseModel):
    """What the viewer may do."""

    simulation: bool = Field(description="whether POST /v1/simulations answers")
    max_reflections: int = Field(description="largest number of reflections of a path in the table")
    open_materials: list[str] = Field(description="materials of the scene that let signals through")


class CellSummary(BaseModel):
    """A cell of the angular grid."""

    index: int
    azimuth_deg: float = Field(description="azimuth of its centre")
    zenith_deg: float
    num_components: int


class ComponentSummary(BaseModel):
    """A component, conditioned on the direction."""

    probability: float = Field(description="fraction of the direction's mixture")
    log_weight: float = Field(description="natural logarithm of that fraction")
    position: Point = Field(description="mean")
    covariance_m2: Matrix
    path_length_m: float
    path_length_stdev_m: float
    num_reflections: int = Field(description="reflections of the path that carries most of the component")
    num_walls: int = Field(description="walls that this path passes")


class MixtureDocument(BaseModel):
    """The mixture of one direction."""

    station_id: str
    in_field_of_view: bool
    level: int = Field(description="level that is looked up; 0 is the finest")
    window_deg: float = Field(description="window of that level")
    cells: list[CellSummary] = Field(
        description="cells that are summed; one, unless the noise is wider than a window; at most 64 are listed"
    )
    num_cells: int
    log_evidence: float | None = Field(description="logarithm of the direction's density; null if no ray arrives")
    num_components: int = Field(description="number of components of all these cells")
    components: list[ComponentSummary] = Field(description="the most probable ones")
    by_reflections: list[float] = Field(description="probability of 0, 1, ... reflections over all components")
    by_walls: list[float] = Field(description="probability that 0, 1, ... walls are passed")


class LevelCoverage(BaseModel):
    """A level by the number of reflections."""

    window_deg: float
    num_cells: int
    num_filled_cells: int
    mass_by_reflections: list[float] = Field(description="fraction of the level's mass with 0, 1, ... reflections")


class CoverageDocument(BaseModel):
    """What the paths of a station reach."""

    station_id: str
    coverage: list[float] = Field(description="fraction of the free space reached with at most 0, 1, ... reflections")
    wall_coverage: list[float] = Field(
        description="fraction of the free space that straight paths through at most 0, 1, ... walls reach; empty where "
        "no wall lets signals through"
    )
    levels: list[LevelCoverage] = Field(description="finest first")


class SimulationRequest(WireModel):
    """A simulation: a UE at a position."""

    model_config = ConfigDict(title="Simulation")

    position: Annotated[list[float], Field(min_length=3, max_length=3)] = Field(
        strict=False, description="an array of x, y and z in the scene frame, m"
    )
    kinds: Annotated[list[Literal["aoa", "pt", "toa", "tdoa"]], Field(min_length=1, max_length=4)] = Field(
        default=["aoa", "pt"], description='an array of kinds of measurements: "aoa", "pt", "toa", "tdoa"'
    )
    angle_stdev_deg: float = Field(
        default=1.0, ge=1e-3, le=90.0, description="a standard deviation, 0.001 to 90 degrees"
    )
    range_stdev_m: float = Field(default=0.5, ge=1e-3, le=1e3, description="a standard deviation, 0.001 to 1000 m")
    seed: int = Field(default=0, ge=0, le=2**53, description="the seed of the noise, an integer of 0 or more")
    target_id: str = Field(default="simulated", max_length=256, description="a name of at most 256 characters")


class PathSummary(BaseModel):
    """The path that the simulated station reports."""

    station_id: str
    azimuth_deg: float
    zenith_deg: float
    path_length_m: float
    num_reflections: int
    num_walls: int


class SimulationDocument(BaseModel):
    """A simulated report, its fix, and the paths without noise."""

    report: ReportDocument
    fix: FixDocument
    paths: list[PathSummary]


class GaussianSummary(BaseModel):
    """A Gaussian of the posterior."""

    probability: float
    position: Point
    covariance_m2: Matrix


class PosteriorDocument(BaseModel):
    """The whole posterior of a report, for pictures."""

    gaussians: list[GaussianSummary] = Field(description="the most probable ones, before the cut to the free space")
    num_gaussians: int
    prior_share: float = Field(description="probability that the report does not constrain the position")
    samples: list[Annotated[list[float], Field(min_length=3, max_length=3)]] = Field(
        description="positions drawn from the posterior, m"
    )


def parse_simulation(body: bytes) -> SimulationRequest:
    """Read the body of a simulation.

    Raises
    ------
    ReportError
        When the body is not JSON or not a valid simulation; the error names every invalid field.
    """
    data = read_json(body)
    try:
        return SimulationRequest.model_validate(data)
    except ValidationError as error:
        raise invalid_report(error, SimulationRequest, data, "the document") from None


def mixture_document(station_id: str, view: DirectionView, *, most_cells: int = 64) -> dict[str, Any]:
    """Build what :class:`MixtureDocument` describes."""
    return {
        "station_id": station_id,
        "in_field_of_view": view.in_field_of_view,
        "level": view.level_index,
        "window_deg": round(math.degrees(view.window), 9),
        "cells": [
            {
                "index": int(index),
                "azimuth_deg": math.degrees(azimuth),
                "zenith_deg": math.degrees(zenith),
                "num_components": int(count),
            }
            for index, (azimuth, zenith), count in zip(
                view.cells[:most_cells], view.centres.tolist(), view.cell_components.tolist(), strict=False
            )
        ],
        "num_cells": len(view.cells),
        "log_evidence": view.log_evidence if math.isfinite(view.log_evidence) else None,
        "num_components": int(view.cell_components.sum()),
        "components": [
            {
                "probability": float(share),
                "log_weight": math.log(share),
                "position": point(place),
                "covariance_m2": cov.tolist(),
                "path_length_m": float(length),
                "path_length_stdev_m": float(stdev),
                "num_reflections": int(reflections),
                "num_walls": int(walls),
            }
            for share, place, cov, length, stdev, reflections, walls in zip(
                view.probability,
                view.position,
                view.position_cov,
                view.path_length,
                view.path_length_stdev,
                view.num_reflections,
                view.num_walls,
                strict=True,
            )
            if share > 0.0
        ],
        "by_reflections": view.by_reflections.tolist(),
        "by_walls": view.by_walls.tolist(),
    }


def path_document(path: SimulatedPath) -> dict[str, Any]:
    """Build what :class:`PathSummary` describes."""
    return {
        "station_id": path.station_id,
        "azimuth_deg": math.degrees(path.azimuth),
        "zenith_deg": math.degrees(path.zenith),
        "path_length_m": path.path_length,
        "num_reflections": path.num_reflections,
        "num_walls": path.num_walls,
    }


def posterior_document(posterior: Posterior, samples: Any, *, most: int = 64) -> dict[str, Any]:
    """Build what :class:`PosteriorDocument` describes; ``samples`` has the shape (n, 3), m."""
    order = (-posterior.log_weight).argsort(kind="stable")[:most]
    return {
        "gaussians": [
            {
                "probability": min(1.0, math.exp(posterior.log_weight[n])),
                "position": point(posterior.mean[n]),
                "covariance_m2": posterior.cov[n].tolist(),
            }
            for n in order
        ],
        "num_gaussians": len(posterior.log_weight),
        "prior_share": posterior.prior_share,
        "samples": samples.round(4).tolist(),
    }


def point(position: Any) -> dict[str, float]:
    """Convert a position of shape (3,), m, to its JSON model."""
    x, y, z = (float(v) for v in position)
    return {"x": x, "y": y, "z": z}
