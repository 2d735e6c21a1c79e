"""The answer to one report, whatever its format."""

from collections.abc import Callable

from rayfix_service.http.answering.locating import Answerer, Incoming
from rayfix_service.http.answering.response_options import ResponseOptions
from rayfix_service.http.answering.served_tables import ServedTable
from rayfix_service.http.routes.json_answer import JsonAnswer
from rayfix_service.http.telemetry.report_figures import Source


async def answer_one(
    read: Callable[[bytes], Incoming],
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
        As `read` does, and as :meth:`~rayfix_service.http.answering.locating.Answerer.answer` does.
    """
    with answerer.metrics.reports.timed(source):
        incoming = await answerer.read(read, body)
        return JsonAnswer(await answerer.answer(table, incoming, options), media_type=options.media_type)
