"""Routes of the scene and of the mixtures of directions, for the viewer."""

import math
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import JSONResponse

from rayfix_service.http.access.guard import charge_report
from rayfix_service.http.problems import (
    FIX_TIMEOUT,
    INVALID_PARAMETER,
    NOT_FOUND,
    NOT_READY,
    OVERLOADED,
    TOO_MANY_REQUESTS,
    ProblemError,
    problem_responses,
)
from rayfix_service.http.routes.dependencies import ServicesDep, TableDep
from rayfix_service.web.documents import CoverageDocument, MixtureDocument, mixture_document
from rayfix_service.web.glb import MEDIA_TYPE, write_glb
from rayfix_service.web.inspector import mass_by_reflections, view_direction
from rayfix_tables.part import StationPart
from rayfix_tables.table import Table

router = APIRouter(prefix="/v1", tags=["viewer"])

_COMPUTED = problem_responses(NOT_FOUND, INVALID_PARAMETER, NOT_READY, TOO_MANY_REQUESTS, OVERLOADED, FIX_TIMEOUT)

_WIDEST_DEG = 30.0
"""Largest standard deviation of a direction: six standard deviations are a full turn."""

StationId = Annotated[str, Path(max_length=128, description="the identifier of a station of the table")]


@router.get(
    "/scene.glb",
    summary="The scene",
    response_class=Response,
    responses={200: {"content": {MEDIA_TYPE: {}}}, **problem_responses(NOT_FOUND, INVALID_PARAMETER, NOT_READY)},
)
async def get_scene(request: Request, services: ServicesDep, served: TableDep) -> Response:
    """Return the mesh as binary glTF: metres, y up by the root node's rotation, materials by name."""
    table = served.locator.table
    tag = f'"{table.table_id[:32]}"'
    headers = {"ETag": tag, "Cache-Control": "no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    body = await services.table_cache.get(table.table_id, "scene.glb", lambda: write_glb(table.scene, table.site.name))
    return Response(body, media_type=MEDIA_TYPE, headers=headers)


@router.get(
    "/stations/{station_id}/mixture",
    summary="The mixture of a direction",
    response_model=MixtureDocument,
    responses=_COMPUTED,
)
async def get_mixture(
    request: Request,
    services: ServicesDep,
    served: TableDep,
    station_id: StationId,
    azimuth_deg: Annotated[float, Query(ge=-180, le=360, allow_inf_nan=False, description="azimuth, scene frame")],
    zenith_deg: Annotated[float, Query(ge=0, le=180, allow_inf_nan=False, description="zenith, scene frame")],
    stdev_deg: Annotated[
        float, Query(ge=1e-3, le=_WIDEST_DEG, allow_inf_nan=False, description="standard deviation of both angles")
    ] = 1.0,
    limit: Annotated[int, Query(ge=1, le=512, description="number of components to return")] = 64,
) -> JSONResponse:
    """Return what the fusion looks up for a measured direction: level, cells, and components conditioned on it.

    It counts as a report for the rate limit.
    """
    table = served.locator.table
    part = _part(table, station_id)
    azimuth = math.remainder(math.radians(azimuth_deg), 2.0 * math.pi)
    zenith, stdev = math.radians(zenith_deg), math.radians(stdev_deg)

    def view() -> dict[str, Any]:
        return mixture_document(
            station_id, view_direction(part, azimuth, zenith, stdev, limit=limit, origin=table.scene.origin)
        )

    charge_report(request)
    return JSONResponse(await services.slow_work.run(view))


@router.get(
    "/stations/{station_id}/coverage",
    summary="Coverage by number of reflections",
    response_model=CoverageDocument,
    responses=_COMPUTED,
)
async def get_coverage(
    request: Request, services: ServicesDep, served: TableDep, station_id: StationId
) -> JSONResponse:
    """Return the fractions of the free space and of each level's mass by number of reflections.

    It counts as a report for the rate limit.
    """
    table = served.locator.table
    part = _part(table, station_id)
    charge_report(request)
    document = await services.table_cache.get(
        table.table_id, f"coverage of {station_id}", lambda: _coverage(station_id, part), run=services.slow_work.run
    )
    return JSONResponse(document)


def _coverage(station_id: str, part: StationPart) -> dict[str, object]:
    return {
        "station_id": station_id,
        "coverage": list(part.coverage),
        "wall_coverage": list(part.wall_coverage),
        "levels": [
            {
                "window_deg": round(math.degrees(level.window), 9),
                "num_cells": level.num_cells,
                "num_filled_cells": int((level.cell_offsets[1:] > level.cell_offsets[:-1]).sum()),
                "mass_by_reflections": mass_by_reflections(level).tolist(),
            }
            for level in part.levels
        ],
    }


def _part(table: Table, station_id: str) -> StationPart:
    part = table.parts.get(station_id)
    if part is None:
        raise ProblemError(NOT_FOUND, f"there is no station {station_id!r}; the stations are {', '.join(table.parts)}")
    return part
