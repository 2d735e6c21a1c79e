"""The web application."""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import Depends, FastAPI
from fastapi.middleware.cors import CORSMiddleware
from pydantic.json_schema import models_json_schema
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rayfix_service.adapters.nrppa_documents import NrppaBatchDocument, NrppaDocument
from rayfix_service.adapters.omlox_hub import open_hub
from rayfix_service.adapters.silabs import SilabsBatchDocument, SilabsDocument
from rayfix_service.http.access.edge import Edge
from rayfix_service.http.access.guard import Access, describe_access
from rayfix_service.http.access.keys import ApiKeys
from rayfix_service.http.access.prefix import Prefix
from rayfix_service.http.access.rates import Accounts, RateLimit
from rayfix_service.http.answering.broker_state import BrokerState
from rayfix_service.http.answering.feed import FixFeed
from rayfix_service.http.answering.feed_relay import FeedRelay
from rayfix_service.http.answering.freed_memory import FreedMemory
from rayfix_service.http.answering.locating import Answerer
from rayfix_service.http.answering.quick_work import QuickWork
from rayfix_service.http.answering.served_tables import ServedTable, Tables
from rayfix_service.http.answering.slow_work import SlowWork
from rayfix_service.http.answering.table_cache import TableCache
from rayfix_service.http.answering.table_checks import TableChecks
from rayfix_service.http.errors import ServiceError
from rayfix_service.http.problems import INVALID_PARAMETER, Problem, install_problems, problem_responses
from rayfix_service.http.routes import formats, health, positions, stream, table
from rayfix_service.http.routes.query_parameters import refuse_unknown_parameters
from rayfix_service.http.routes.stream import FixEventDocument
from rayfix_service.http.services import Services, set_services
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.http.telemetry.connections import NOTE
from rayfix_service.http.telemetry.metrics import Metrics, forget_dead_workers
from rayfix_service.http.telemetry.request_context import HEADER, RequestContext, UnderWay
from rayfix_service.server.collection import collect_while_idle
from rayfix_service.server.fast_path import FastPath
from rayfix_service.server.stopping import on_stop_signal
from rayfix_service.web import routes_assets, routes_scene, routes_simulation
from rayfix_service.web.documents import SimulationRequest
from rayfix_service.wire import BatchDocument, ReportDocument

_SECOND_LOOK_SECONDS = 0.5

_log = logging.getLogger(__name__)

_DESCRIPTION = """\
Indoor positions from angles and times of arrival, fused with a digital twin of the building.

Coordinates are in the scene frame of the site, right-handed, z up, in metres. An azimuth counts
counter-clockwise from the frame's +x axis, a zenith angle from straight up; both are of the direction from
the station towards the incoming ray. Every error is a problem document (RFC 9457) that names the field.
"""


class RayfixApp(FastAPI):
    """FastAPI with this service's middlewares outside of FastAPI's own.

    Responses of these middlewares bypass FastAPI's own, which take 4 us per request. The OpenAPI document also has the
    schemas of the bodies that the routes parse themselves.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._outermost: ASGIApp = super().__call__

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        await self._outermost(scope, receive, send)

    def surround(self, middleware: Callable[..., ASGIApp], **options: Any) -> None:
        """Add a middleware outside of all others."""
        self._outermost = middleware(self._outermost, **options)

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document."""
        if self.openapi_schema is None:
            document = super().openapi()
            _, schemas = models_json_schema(
                [
                    (ReportDocument, "validation"),
                    (BatchDocument, "validation"),
                    (NrppaDocument, "validation"),
                    (NrppaBatchDocument, "validation"),
                    (SilabsDocument, "validation"),
                    (SilabsBatchDocument, "validation"),
                    (FixEventDocument, "validation"),
                    (SimulationRequest, "validation"),
                    (Problem, "serialization"),
                ],
                ref_template="#/components/schemas/{model}",
            )
            document["components"]["schemas"].update(schemas["$defs"])
            describe_access(document)
            _describe_parameters(document)
            self.openapi_schema = document
        return self.openapi_schema


def _describe_parameters(document: dict[str, Any]) -> None:
    """Document in OpenAPI that every path refuses unknown query parameters."""
    refusals = {str(status): response for status, response in problem_responses(INVALID_PARAMETER).items()}
    for operations in document["paths"].values():
        for operation in operations.values():
            operation["responses"] = refusals | operation["responses"]


def create_app(
    tables_path: Path,
    settings: ServiceSettings | None = None,
    *,
    at_hand: dict[str, ServedTable] | None = None,
    accounts: Accounts | None = None,
) -> FastAPI:
    """Create the web application that serves one or several tables.

    It listens at once and answers ``/livez`` while a thread verifies the tables and compiles the kernels. Then
    ``/readyz`` returns 200 and the other routes answer. Afterwards it watches the tables' files for changes.

    Parameters
    ----------
    tables_path : pathlib.Path
        The table, or a folder of tables. While a single table fails its check, the application is not ready.
    settings : ServiceSettings, optional
    at_hand : dict of str to ServedTable, optional
        Tables that are already verified, by name; they are served at once. The application removes them from the dict.
    accounts : Accounts, optional
        Accounts of the clients' rates, which several processes may share.

    Raises
    ------
    ServiceError
        When the key file cannot be used.
    """
    settings = settings or ServiceSettings()
    keys = None if settings.api_keys is None else ApiKeys(settings.api_keys)
    metrics, under_way = Metrics(), UnderWay()
    feed = FixFeed(settings.feed_limits)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[dict[str, Any]]:
        tables = Tables(
            tables_path,
            metrics,
            runtime_folder=settings.runtime_folder,
            at_hand=at_hand,
            checks=TableChecks(settings.runtime_folder, settings.table_check),
        )
        keeping = [asyncio.create_task(tables.keep(settings.watch_seconds))]
        if keys is not None:
            keeping.append(asyncio.create_task(_keep_keys(keys, settings.watch_seconds)))
        relay = None
        if settings.runtime_folder is not None:
            relay = FeedRelay(feed, settings.runtime_folder)
            keeping.append(asyncio.create_task(relay.keep()))
        freed = FreedMemory() if settings.own_process else None
        quick_work = QuickWork(2.0 * settings.quick_fix_seconds)
        slow_work = SlowWork(
            threads=settings.slow_fix_threads,
            waiting=settings.slow_fixes_waiting,
            seconds=settings.fix_seconds,
            on_done=None if freed is None else freed.soon,
        )
        broker = None
        if settings.mqtt is not None:
            broker = BrokerState(settings.mqtt.broker.address, settings.runtime_folder)
        stopping = asyncio.Event()

        def stop() -> None:
            stopping.set()
            feed.close()

        try:
            with on_stop_signal(stop):
                async with open_hub(settings.hub, on_outcome=metrics.hub_told) as hub:
                    answerer = Answerer(
                        metrics=metrics,
                        feed=feed,
                        quick_work=quick_work,
                        slow_work=slow_work,
                        hub=hub,
                        quick_seconds=settings.quick_fix_seconds,
                        message_limits=settings.message_limits,
                        freed_memory=freed,
                    )
                    services = Services(
                        settings=settings,
                        metrics=metrics,
                        tables=tables,
                        answerer=answerer,
                        slow_work=slow_work,
                        table_cache=TableCache(),
                        feed=feed,
                        relay=relay,
                        broker=broker,
                    )
                    set_services(app.state, services)
                    if settings.runtime_folder is not None:
                        forget_dead_workers()
                        await _take_turn(tables, settings.runtime_folder / "ready", stopping)
                    await _prepare_requests(app)
                    if settings.own_process:  # now that what lasts has been made
                        keeping.append(asyncio.create_task(_collect(tables, under_way)))
                    async with _broker_read(services):
                        yield {NOTE: metrics.connection_closed}
        finally:
            stop()
            for task in keeping:
                task.cancel()
            await asyncio.wait(keeping)
            quick_work.close()
            slow_work.close()
            if freed is not None:
                freed.close()

    app = RayfixApp(
        title="rayfix",
        description=_DESCRIPTION,
        version="1",
        lifespan=lifespan,
        dependencies=[Depends(refuse_unknown_parameters)],
        openapi_url=None,  # routes_assets has a route with the examples of the table and the proxy's path
        docs_url=None,  # FastAPI's page loads its script from another host; the page of routes_assets does not
        redoc_url=None,
        redirect_slashes=False,  # a redirected POST loses its body in many clients; a 404 is clear
        # /metrics has all metrics, and checking at each request for other telemetry is slow.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    install_problems(app)
    app.surround(FastPath, path="/v1/positions", answer=partial(positions.answer_position, app.state))
    app.surround(Access, keys=keys, limit=_rate_limit(settings, accounts))
    if settings.cors_origins:
        # Outside of the access control, because a browser's preflight request has no key.
        app.surround(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "POST"],
            allow_headers=["Authorization", "Content-Type", "X-API-Key", HEADER],
            expose_headers=["Retry-After", HEADER],
        )
    app.surround(
        Edge, hosts=settings.hosts, origins=tuple(settings.cors_origins), asks_for_keys=settings.api_keys is not None
    )
    app.surround(Prefix, root_path=settings.root_path, trusts_header=settings.trust_forwarded_prefix)
    app.surround(RequestContext, metrics=metrics, under_way=under_way)
    app.include_router(positions.router)
    app.include_router(formats.router)
    app.include_router(stream.router)
    app.include_router(table.router)
    app.include_router(health.router)
    app.include_router(routes_scene.router)
    app.include_router(routes_simulation.router)
    app.include_router(routes_assets.router)
    return app


def _rate_limit(settings: ServiceSettings, accounts: Accounts | None) -> RateLimit | None:
    rate = settings.reports_per_second
    return None if rate is None else RateLimit(rate, max(1.0, rate * settings.burst_seconds), accounts=accounts)


async def _keep_keys(keys: ApiKeys, seconds: float) -> None:
    """Reload the keys periodically; while their file cannot be used, the previous keys stay valid."""
    failure, is_settled = "", True
    while True:
        await asyncio.sleep(seconds if is_settled else min(seconds, _SECOND_LOOK_SECONDS))
        try:
            is_settled = await keys.reread()
        except ServiceError as error:
            if failure != (failure := str(error)):
                _log.error("keys not read again: %s", error)
        else:
            failure = ""


@asynccontextmanager
async def _broker_read(services: Services) -> AsyncIterator[None]:
    """Read the service's MQTT broker meanwhile, if it has one and no other worker does."""
    source, state = services.settings.mqtt, services.broker
    if source is None or state is None:
        yield
        return
    # Imported here, since it needs an extra that a service without a broker may lack.
    from rayfix_service.http.answering.mqtt_listener import listen

    async def read() -> None:
        try:
            await listen(source, state, services.tables, services.answerer)
        except Exception:  # what is asked by HTTP is answered all the same
            _log.critical("the MQTT broker is no longer read", exc_info=True)

    reading = asyncio.create_task(read())
    try:
        yield
    finally:
        reading.cancel()
        await asyncio.wait([reading])


async def _prepare_requests(app: FastAPI) -> None:
    """Do what FastAPI and anyio put off until the first request, which would hold the event loop for 30 ms.

    FastAPI prepares the routes of a router when a request is first compared with them, and anyio imports its support of
    asyncio when it is first asked whether a client has left.
    """

    async def receive() -> Message:
        return {"type": "http.disconnect"}

    async def send(_: Message) -> None:
        pass

    scope = {"type": "http", "method": "GET", "path": "/v1/none", "root_path": "", "query_string": b"", "headers": []}
    await app.router(scope, receive, send)
    await Request(scope, receive).is_disconnected()


async def _collect(tables: Tables, under_way: UnderWay) -> None:
    """Collect reference cycles in idle moments, once the process is ready."""
    await tables.became_ready.wait()
    await collect_while_idle(under_way)


async def _take_turn(tables: Tables, marker: Path, stopping: asyncio.Event) -> None:
    """Let a worker that replaces another listen only once it can locate.

    Until then the other workers take all connections. The first workers do not wait, so ``/livez`` answers at once. A
    file in their shared folder marks that some worker has been able to locate.
    """
    if marker.exists():
        waiting = [asyncio.create_task(event.wait()) for event in (tables.became_ready, stopping)]
        await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        for task in waiting:
            task.cancel()
