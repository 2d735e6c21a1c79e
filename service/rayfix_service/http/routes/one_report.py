"""The answer to one report, whatever its format."""

from functools import partial
from typing import Protocol

from rayfix_service.http.answering.locating import Answerer, Incoming
from rayfix_service.http.answering.response_options import ResponseOptions
from rayfix_service.http.answering.served_tables import ServedTable
from rayfix_service.http.routes.json_answer import JsonAnswer
from rayfix_service.http.telemetry.report_figures import Source
from rayfix_service.wire.limits import MessageLimits


class ReadOne(Protocol):
    """Reads the JSON text of one report."""

    def __call__(self, text: bytes, /, *, limits: MessageLimits) -> Incoming:
        """Read it, within limits."""


async def answer_one(
    read_one: ReadOne,
    body: bytes,
    answerer: Answerer,
    table: ServedTable,
    options: ResponseOptions,
    source: Source,
) -> JsonAnswer:
    """Read a report, locate it, write the answer, and count it.

    Raises
    ------
    ReportError, ProblemError
        As `read_one` does, and as :meth:`~rayfix_service.http.answering.locating.Answerer.answer` does.
    """
    with answerer.metrics.reports.timed(source):
        incoming = await answerer.read(partial(read_one, limits=answerer.message_limits), body)
        return JsonAnswer(await answerer.answer(table, incoming, options), media_type=options.media_type)
