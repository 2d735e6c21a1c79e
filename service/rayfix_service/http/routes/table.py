"""Routes that describe the table."""

from fastapi import APIRouter
from pydantic import BaseModel

from rayfix_service.http.answering.served_tables import Change
from rayfix_service.http.problems import (
    INVALID_PARAMETER,
    NOT_FOUND,
    NOT_READY,
    TABLE_REFUSED,
    ProblemError,
    problem_responses,
)
from rayfix_service.http.routes.dependencies import TableDep, TablesDep
from rayfix_service.wire import FieldProblem
from rayfix_service.wire.table import (
    StationSummary,
    TableSummary,
    station_summary,
    table_summary,
)

router = APIRouter(prefix="/v1", tags=["table"])


class TableList(BaseModel):
    """The tables that answer."""

    tables: list[TableSummary]


class ReloadedTable(BaseModel):
    """What became of a table."""

    name: str
    change: Change


class Reloaded(BaseModel):
    """What became of all tables."""

    tables: list[ReloadedTable]


class StationList(BaseModel):
    """The stations of the site."""

    stations: list[StationSummary]


_ONE_TABLE = problem_responses(INVALID_PARAMETER, NOT_FOUND, NOT_READY)


@router.get("/table", summary="The table", responses=_ONE_TABLE)
async def get_table(table: TableDep) -> TableSummary:
    """Tell which table answers, and which site it was built for."""
    return table_summary(table.name, table.locator.table)


@router.get("/tables", summary="All tables", responses=problem_responses(NOT_READY))
async def get_tables(tables: TablesDep) -> TableList:
    """List the tables that answer."""
    return TableList(tables=[table_summary(table.name, table.locator.table) for table in tables.all()])


@router.post("/tables/reload", summary="Load new tables", responses=problem_responses(TABLE_REFUSED))
async def post_reload(tables: TablesDep) -> Reloaded:
    """Look at the tables' files now: load what is new and drop what is gone.

    A new file is verified first, while the table that it replaces answers; one that does not pass is refused with 409,
    and the table that it was to replace goes on answering. Other worker processes follow within seconds.
    """
    changes = await tables.reload()
    refused = [change for change in changes if change.change == "refused"]
    if refused:
        raise ProblemError(
            TABLE_REFUSED,
            f"{refused[0].reason}; what answered before answers on",
            errors=[FieldProblem(path=(change.name,), message=change.reason or "") for change in refused],
        )
    return Reloaded(tables=[ReloadedTable(name=change.name, change=change.change) for change in changes])


@router.get("/stations", summary="The stations", responses=_ONE_TABLE)
async def get_stations(served: TableDep) -> StationList:
    """List the stations that reports may name, with their levels in the table."""
    table = served.locator.table
    return StationList(stations=[station_summary(s, table.levels(s.id)) for s in table.site.stations])
