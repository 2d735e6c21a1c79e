"""Routes for whoever watches the process."""

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel, Field

from rayfix_service.http.dependencies import LocatorDep
from rayfix_service.http.problems import NOT_READY, problem_responses

router = APIRouter(tags=["health"])


class Alive(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Ready(BaseModel):
    """The table is checked and the kernels are compiled."""

    status: Literal["ready"] = "ready"
    table_id: str = Field(description="SHA-256 of the table's content")


@router.get("/livez", summary="Does the process answer?")
async def livez() -> Alive:
    """Answer 200 as soon as the process listens."""
    return Alive()


@router.get("/readyz", summary="Can it locate?", responses=problem_responses(NOT_READY))
async def readyz(locator: LocatorDep) -> Ready:
    """Answer 200 once the table is checked and the kernels are compiled, and 503 before."""
    return Ready(table_id=locator.table.table_id)
