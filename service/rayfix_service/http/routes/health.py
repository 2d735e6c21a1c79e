"""Routes for whoever watches the process."""

from typing import Literal

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel, Field

from rayfix_service.http.answering.broker_state import BrokerConnection
from rayfix_service.http.problems import NOT_READY, problem_responses
from rayfix_service.http.routes.dependencies import ServicesDep

router = APIRouter(tags=["health"])


class Alive(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class ReadyTable(BaseModel):
    """A table that answers."""

    name: str
    table_id: str = Field(description="SHA-256 of the table's content")


class ReadyBroker(BaseModel):
    """The MQTT broker that the service reads."""

    address: str = Field(description="host and port")
    connection: BrokerConnection = Field(description="whether one of the workers reads it; a lost one is tried again")


class Ready(BaseModel):
    """All tables are checked, at least one answers, and the kernels are compiled."""

    status: Literal["ready"] = "ready"
    tables: list[ReadyTable]
    refused: list[str] = Field(
        default=[],
        description="names of files that do not pass their check; a table that was loaded before may answer for one",
    )
    mqtt: ReadyBroker | None = Field(
        default=None,
        description="of a service that reads an MQTT broker; without it, requests are answered all the same",
    )


@router.get("/livez", summary="Does the process answer?")
async def livez() -> Alive:
    """Answer 200 as soon as the process listens."""
    return Alive()


@router.get(
    "/readyz", summary="Can it locate?", responses=problem_responses(NOT_READY), response_model_exclude_none=True
)
async def readyz(services: ServicesDep) -> Ready:
    """Answer 200 once all tables are checked and the kernels are compiled, and 503 before."""
    tables, broker = services.tables, services.broker
    return Ready(
        tables=[ReadyTable(name=t.name, table_id=t.locator.table.table_id) for t in tables.all()],
        refused=list(tables.refused),
        mqtt=None if broker is None else ReadyBroker(address=broker.address, connection=broker.connection()),
    )


@router.get(
    "/metrics",
    summary="Figures for Prometheus",
    response_class=PlainTextResponse,
    responses=problem_responses(NOT_READY),
)
async def metrics(request: Request, services: ServicesDep) -> Response:
    """Tell how many requests and fixes there were, how long they took, and which table answers."""
    text, media_type = services.metrics.exposition(request.headers.get("accept", ""))
    return Response(text, headers={"content-type": media_type})
