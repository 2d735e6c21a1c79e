"""A client of the service: :class:`Client` and :class:`AsyncClient`, their answers and errors.

It needs only the extra ``rayfix[client]``; no other extra and no table.
"""

from rayfix.client.asynchronous import AsyncClient
from rayfix.client.models import (
    Candidate,
    FixAnswer,
    FixEvent,
    Outcome,
    Point,
    SkippedMeasurement,
    StationAnswer,
    TableAnswer,
    TrackAnswer,
)
from rayfix.client.retries import RetryPolicy
from rayfix.client.synchronous import Client
from rayfix.errors import (
    AnswerError,
    ClientError,
    ProblemError,
    RefusedReportError,
    UnreachableError,
)

__all__ = [
    "AnswerError",
    "AsyncClient",
    "Candidate",
    "Client",
    "ClientError",
    "FixAnswer",
    "FixEvent",
    "Outcome",
    "Point",
    "ProblemError",
    "RefusedReportError",
    "RetryPolicy",
    "SkippedMeasurement",
    "StationAnswer",
    "TableAnswer",
    "TrackAnswer",
    "UnreachableError",
]
