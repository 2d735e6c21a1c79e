"""Answering the reports of a batch, each on its own."""

from dataclasses import replace
from functools import partial
from typing import Any

from fastapi import Request

from rayfix_service.http.access.guard import charge_reports
from rayfix_service.http.answering.cooperative import Cooperation
from rayfix_service.http.answering.locating import Answerer, Incoming
from rayfix_service.http.answering.response_options import ResponseOptions
from rayfix_service.http.answering.served_tables import ServedTable
from rayfix_service.http.routes.json_answer import ResultsAnswer, write_json
from rayfix_service.http.routes.one_report import ReadOne
from rayfix_service.http.telemetry.report_figures import Source
from rayfix_service.wire import MalformedJsonError
from rayfix_service.wire.batches import split_batch


async def answer_batch(
    request: Request,
    answerer: Answerer,
    table: ServedTable,
    body: bytes,
    options: ResponseOptions,
    read_one: ReadOne,
    source: Source,
) -> ResultsAnswer:
    """Read all reports of a batch, then locate them in their order.

    Raises
    ------
    MalformedJsonError
        For a batch, or a report in it, that is not JSON.
    ReportError
        For what is not a batch.
    """
    limits = answerer.message_limits
    texts = await answerer.read(partial(split_batch, limits=limits), body)
    charge_reports(request, len(texts))
    cooperation = Cooperation(request)
    reports: list[Incoming | dict[str, Any]] = []  # all, before the first is located: a batch is JSON or it is not
    listed = 0
    for number, text in enumerate(texts):
        await cooperation.let_others_run()
        own = limits if listed < limits.listed_problems else replace(limits, listed_problems=1)
        try:
            reports.append(await answerer.read(partial(read_one, limits=own), text))
        except MalformedJsonError as error:
            raise MalformedJsonError(f"reports[{number}]: {error}") from None
        except Exception as error:
            problem = answerer.unread(error, source)
            if (left_out := len(problem["errors"]) - own.listed_problems) > 0:
                problem["more_errors"] = problem.get("more_errors", 0) + left_out
                del problem["errors"][own.listed_problems :]
            reports.append(problem)
            listed += len(problem["errors"])
    results: list[bytes] = []
    for report in reports:  # not by locate_batch: other batches keep the other workers, one for each core, as busy
        if isinstance(report, Incoming):
            await cooperation.let_others_run()
            answer = await answerer.answer_or_problem(table, partial(_itself, report), options, source)
            results.append(write_json(answer))
        else:
            results.append(write_json(report))
    return ResultsAnswer(results)


def _itself(report: Incoming) -> Incoming:
    return report
