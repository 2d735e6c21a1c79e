"""Routes that simulate reports and return whole posteriors."""

from time import perf_counter
from typing import Any, Protocol

import numpy as np
from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse

from rayfix_service.fusion.stopping import Stop
from rayfix_service.http.answering.slow_work import Asked_contra, Stoppable
from rayfix_service.http.openapi.examples import REPORT_EXAMPLES
from rayfix_service.http.openapi.responses import POSITION_PROBLEMS, request_body
from rayfix_service.http.problems import (
    FORBIDDEN,
    INVALID_PARAMETER,
    NOT_FOUND,
    NOT_READY,
    ProblemError,
    problem_responses,
)
from rayfix_service.http.routes.dependencies import ReportBody, ServicesDep, TableDep
from rayfix_service.locator import Locator
from rayfix_service.web.documents import (
    PosteriorDocument,
    SimulationDocument,
    SimulationRequest,
    ViewerSettings,
    parse_simulation,
    path_document,
)
from rayfix_service.web.simulation import simulate
from rayfix_service.web.viewer_settings import picture_posterior, viewer_settings
from rayfix_service.wire import ReportDocument, fix_to_document, parse_report

router = APIRouter(prefix="/v1", tags=["viewer"])

SIMULATION_EXAMPLES = {
    "in_the_hall": {
        "summary": "Angles and propagation times of a UE in the hall",
        "value": {"position": [5.32, 14.2, 0.67], "kinds": ["aoa", "pt"], "angle_stdev_deg": 1.0, "seed": 1},
    }
}


@router.get(
    "/viewer", summary="What the viewer may do", responses=problem_responses(NOT_FOUND, INVALID_PARAMETER, NOT_READY)
)
async def get_viewer_settings(request: Request, services: ServicesDep, served: TableDep) -> ViewerSettings:
    """Return the viewer's settings: whether it may simulate, and the largest number of reflections of a path."""
    return viewer_settings(served.locator.table, simulation=services.settings.simulation)


@router.post(
    "/simulations",
    summary="Simulate a report and locate it",
    response_model=SimulationDocument,
    responses={**POSITION_PROBLEMS, **problem_responses(FORBIDDEN)},
    openapi_extra=request_body(SimulationRequest, SIMULATION_EXAMPLES),
)
async def post_simulation(request: Request, services: ServicesDep, served: TableDep, body: ReportBody) -> JSONResponse:
    """Simulate the report of a UE at a position from the table, with noise, and locate it.

    Only this response has the fix: the stream of fixes and the metrics do not include it.
    """
    if not services.settings.simulation:
        raise ProblemError(
            FORBIDDEN, "this service does not simulate; start it with --allow-simulation, or listen on loopback"
        )
    wanted = parse_simulation(body)
    return JSONResponse(await services.slow_work.locate(_on(served.locator, _simulate_and_locate), wanted))


@router.post(
    "/posteriors",
    summary="The whole posterior of a report",
    response_model=PosteriorDocument,
    responses=POSITION_PROBLEMS,
    openapi_extra=request_body(ReportDocument, REPORT_EXAMPLES),
)
async def post_posterior(request: Request, services: ServicesDep, served: TableDep, body: ReportBody) -> JSONResponse:
    """Return the Gaussians of the posterior and positions drawn from it, for pictures."""
    incoming = await services.answerer.read_report(body)
    return JSONResponse(await services.slow_work.locate(_on(served.locator, picture_posterior), incoming.report))


class _Work(Protocol[Asked_contra]):
    """The work of a route, given the locator."""

    def __call__(self, locator: Locator, asked: Asked_contra, /, *, stop: Stop) -> dict[str, Any]: ...


def _on(locator: Locator, work: _Work[Asked_contra]) -> Stoppable[Asked_contra, dict[str, Any]]:
    def do(asked: Asked_contra, /, *, stop: Stop) -> dict[str, Any]:
        return work(locator, asked, stop=stop)

    return do


def _simulate_and_locate(locator: Locator, wanted: SimulationRequest, *, stop: Stop) -> dict[str, Any]:
    paths, measurements = simulate(
        locator.table,
        wanted.position,
        kinds=wanted.kinds,
        angle_stdev=float(np.deg2rad(wanted.angle_stdev_deg)),
        range_stdev=wanted.range_stdev_m,
        rng=np.random.default_rng(wanted.seed),
    )
    report = {"target_id": wanted.target_id, "measurements": measurements}
    begin = perf_counter()
    fix = locator.locate(parse_report(report), stop=stop)
    return {
        "report": report,
        "fix": fix_to_document(fix, perf_counter() - begin),
        "paths": [path_document(path) for path in paths],
    }
