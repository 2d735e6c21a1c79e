"""The web application of one table."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from rayfix_service.adapters.nrppa_documents import NrppaDocument
from rayfix_service.adapters.silabs import SilabsDocument
from rayfix_service.fusion.locator import Locator
from rayfix_service.http import routes_formats, routes_health, routes_positions, routes_stream, routes_table
from rayfix_service.http.dependencies import BodyLimits, Service
from rayfix_service.http.feed import FixFeed
from rayfix_service.http.metrics import Metrics
from rayfix_service.http.problems import Problem, install_problems
from rayfix_service.http.request_context import RequestContext
from rayfix_service.http.routes_stream import FixEventDocument
from rayfix_service.http.stopping import on_stop_signal
from rayfix_service.wire import BatchDocument, ReportDocument
from rayfix_tables.table import Table

_DESCRIPTION = """\
Indoor positions from angles and times of arrival, fused with a digital twin of the building.

Coordinates are in the scene frame of the site, right-handed, z up, in metres. An azimuth counts
counter-clockwise from the frame's +x axis, a zenith angle from straight up; both are of the direction from
the station towards the incoming ray. Every error is a problem document (RFC 9457) that names the field.
"""


class RayfixApp(FastAPI):
    """FastAPI, whose OpenAPI document also has the schemas of the bodies that the routes read themselves."""

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document."""
        if self.openapi_schema is None:
            document = super().openapi()
            _, schemas = models_json_schema(
                [
                    (ReportDocument, "validation"),
                    (BatchDocument, "validation"),
                    (NrppaDocument, "validation"),
                    (SilabsDocument, "validation"),
                    (FixEventDocument, "validation"),
                    (Problem, "serialization"),
                ],
                ref_template="#/components/schemas/{model}",
            )
            document.setdefault("components", {}).setdefault("schemas", {}).update(schemas["$defs"])
            self.openapi_schema = document
        return self.openapi_schema


def create_app(table_path: Path, *, body_limits: BodyLimits | None = None) -> FastAPI:
    """Make the web application that answers from one table.

    At its start it maps the table and listens; ``/livez`` answers. Meanwhile a thread verifies the table and
    compiles the kernels; then ``/readyz`` turns 200 and the other routes answer.

    Parameters
    ----------
    table_path : pathlib.Path
        The table. A file that cannot be opened stops the start; one that does not pass its check leaves the
        application not ready.
    body_limits : BodyLimits, optional
        How long requests may be.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        table = Table.open(table_path)
        app.state.metrics.table_opened(table)
        app.state.service = Service(Locator(table), on_ready=app.state.metrics.became_ready)
        preparation = asyncio.create_task(app.state.service.prepare())
        try:
            with on_stop_signal(app.state.feed.close):
                yield
        finally:
            app.state.feed.close()
            await preparation  # its thread would outlive the loop

    app = RayfixApp(
        title="rayfix",
        description=_DESCRIPTION,
        version="1",
        lifespan=lifespan,
        redoc_url=None,
        redirect_slashes=False,  # a redirected POST loses its body in many clients; a 404 is clear
    )
    app.state.body_limits = body_limits or BodyLimits()
    app.state.metrics = Metrics()
    app.state.feed = FixFeed()
    install_problems(app)
    app.add_middleware(RequestContext, metrics=app.state.metrics)  # around all, to see the last resort's answers too
    app.include_router(routes_positions.router)
    app.include_router(routes_formats.router)
    app.include_router(routes_stream.router)
    app.include_router(routes_table.router)
    app.include_router(routes_health.router)
    return app
