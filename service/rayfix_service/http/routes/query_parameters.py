"""Query parameters that a route does not know are refused: a misspelt one would be a default without a word."""

import difflib
from collections.abc import Iterator

from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute, APIWebSocketRoute
from starlette.requests import HTTPConnection

from rayfix_service.http.problems import INVALID_PARAMETER, ProblemError
from rayfix_service.wire import FieldProblem
from rayfix_service.wire.limits import USUAL_LIMITS
from rayfix_tables.validation.problems import shown


async def refuse_unknown_parameters(connection: HTTPConnection) -> None:
    """Refuse a request whose query has parameters that its route does not know.

    Pages and their files, which are in no OpenAPI document, are let alone: links to them may carry marks of others.

    Raises
    ------
    ProblemError
        Names each of them, and those that are known.
    """
    if not connection.scope["query_string"]:
        return
    route = connection.scope.get("route")
    if not isinstance(route, APIRoute | APIWebSocketRoute) or not getattr(route, "include_in_schema", True):
        return
    names = set(_names(route.dependant))
    unknown = list(dict.fromkeys(name for name in connection.query_params if name not in names))
    if unknown:
        known = sorted(names)
        problems = [
            FieldProblem(path=(name,), message=_message(name, known))
            for name in unknown[: USUAL_LIMITS.listed_problems]
        ]
        raise ProblemError(INVALID_PARAMETER, problems[0].message, errors=problems)


def _message(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name[:60], known, n=1)
    if close:
        remedy = f"did you mean {close[0]}? The path knows {', '.join(known)}"
    else:
        remedy = f"the path knows {', '.join(known)}" if known else "the path knows none"
    return f"there is no query parameter {shown(name)}; {remedy}"


def _names(dependant: Dependant) -> Iterator[str]:
    """Names of the query parameters of a route and its dependencies."""
    yield from (field.alias for field in dependant.query_params)
    for dependency in dependant.dependencies:
        yield from _names(dependency)
