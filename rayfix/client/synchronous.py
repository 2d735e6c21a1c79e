"""The blocking client."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from random import Random
from types import TracebackType
from typing import Any, Self, TypeVar

from rayfix.client.calls import (
    Call,
    Flow,
    NoReply,
    Pause,
    Reply,
    batch_answers,
    batch_calls,
    position_call,
    reason_of,
    report_bytes,
    request,
    stream_answer,
)
from rayfix.client.errors import ProblemError, UnreachableError
from rayfix.client.feed import SILENCE_SECONDS, Feed
from rayfix.client.models import (
    FixAnswer,
    FixEvent,
    StationAnswer,
    TableAnswer,
    fix_answer,
    station_answers,
    table_answer,
    table_answers,
)
from rayfix.client.retries import NO_RETRIES, RetryPolicy
from rayfix.client.settings import ClientSettings
from rayfix.extras import needs_extra

with needs_extra("client"):
    import httpx

T = TypeVar("T")


class Client:
    """Asks a service for positions. It may be used from several threads; close it, or use it as a context.

    Parameters
    ----------
    url : str
        Address of the service, such as ``http://localhost:8000``.
    api_key, table, track, timeout, retries
        As in :class:`~rayfix.client.settings.ClientSettings`.
    transport : httpx.BaseTransport, optional
        What carries the requests, for tests and special networks.

    Raises
    ------
    ClientError
        When ``url`` is no address. All methods raise kin of it; docs/client.md lists them.
    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        table: str | None = None,
        track: bool | None = None,
        timeout: float = 30.0,
        retries: RetryPolicy | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.settings = ClientSettings(
            url=url, api_key=api_key, table=table, track=track, timeout=timeout, retries=retries or RetryPolicy()
        )
        self._random = Random()
        self._http = httpx.Client(headers=self.settings.headers, timeout=timeout, transport=transport)

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the client."""
        self.close()

    def close(self) -> None:
        """Close its connections."""
        self._http.close()

    def locate(self, report: Mapping[str, Any] | object) -> FixAnswer:
        """Locate one report.

        Parameters
        ----------
        report : Mapping or rayfix.Report
            A mapping has the form of the JSON that ``POST /v1/positions`` takes.
        """
        return self._ask(position_call(report, self.settings.position_query), fix_answer)

    def locate_as(self, report: Mapping[str, Any] | object, output: str) -> dict[str, Any]:
        """Locate one report; returns the answer's JSON in a format of docs/formats.md, such as ``"omlox"``."""
        return self._ask(position_call(report, self.settings.position_query | {"output": output}), dict)

    def locate_batch(self, reports: Iterable[Mapping[str, Any] | object]) -> list[FixAnswer | ProblemError]:
        """Locate any number of reports, in as many requests as that takes.

        Returns
        -------
        list of (FixAnswer or ProblemError)
            In the order of the reports; the error, not raised, of a report that cannot be used.
        """
        answers: list[FixAnswer | ProblemError] = []
        for count, call in batch_calls(reports, self.settings.position_query):
            answers += self._ask(call, partial(batch_answers, count=count))
        return answers

    def stations(self) -> tuple[StationAnswer, ...]:
        """List the stations that reports may name."""
        call = Call(method="GET", path="/v1/stations", query=self.settings.table_query)
        return self._ask(call, station_answers)

    def table(self) -> TableAnswer:
        """Tell which table answers."""
        return self._ask(Call(method="GET", path="/v1/table", query=self.settings.table_query), table_answer)

    def tables(self) -> tuple[TableAnswer, ...]:
        """List all tables of the service."""
        return self._ask(Call(method="GET", path="/v1/tables"), table_answers)

    def ready(self) -> bool:
        """Whether the service can locate now; asks once."""
        try:
            self._drive(request(Call(method="GET", path="/readyz"), dict, NO_RETRIES, self._random))
        except (ProblemError, UnreachableError):
            return False
        return True

    def fixes(self, target_id: str | None = None) -> Iterator[FixEvent]:
        """Listen to the fixes that the service makes of anyone's reports, until the iteration is ended.

        A connection that is lost is made again; fixes in between are lost.

        Parameters
        ----------
        target_id : str, optional
            The only target to hear of.
        """
        query = self.settings.feed_query(target_id)
        feed = Feed(self.settings.retries, self._random)
        while True:
            try:
                with self._http.stream(
                    "GET", self.settings.base + "/v1/fixes", params=query, timeout=SILENCE_SECONDS
                ) as answer:
                    if answer.status_code == 200:
                        feed.opened()
                        for line in answer.iter_lines():
                            event = feed.take(line)
                            if event is not None:
                                yield event
                        pause = feed.lost("the service ended it")
                    else:
                        body = answer.read()
                        pause = feed.refused(answer.status_code, body, answer.headers.get("retry-after"))
            except httpx.TransportError as error:
                pause = feed.lost(reason_of(error))
            time.sleep(pause)

    def stream(self, reports: Iterable[Mapping[str, Any] | object]) -> Iterator[FixAnswer | ProblemError]:
        """Send reports over one web socket, each when the last is answered; yields the answers.

        For one sender of many reports this is faster than requests. A lost connection is not made again.
        """
        with needs_extra("client"):
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        try:
            with connect(self.settings.stream_url, additional_headers=self.settings.headers) as socket:
                for report in reports:
                    socket.send(report_bytes(report), text=True)
                    yield stream_answer(socket.recv(self.settings.timeout))
        except (OSError, WebSocketException) as error:
            raise UnreachableError(f"the stream is lost ({reason_of(error)}); is the service still there?") from None

    def _ask(self, call: Call, parse: Callable[[Any], T]) -> T:
        return self._drive(request(call, parse, self.settings.retries, self._random))

    def _drive(self, flow: Flow[T]) -> T:
        reply: Reply | NoReply | None = None
        while True:
            try:
                wanted = flow.send(reply)
            except StopIteration as stop:
                result: T = stop.value
                return result
            reply = None
            if isinstance(wanted, Pause):
                time.sleep(wanted.seconds)
            else:
                reply = self._send(wanted)

    def _send(self, call: Call) -> Reply | NoReply:
        try:
            answer = self._http.request(
                call.method,
                self.settings.base + call.path,
                params=dict(call.query),
                headers=dict(call.headers),
                content=call.body,
            )
        except httpx.TransportError as error:
            return NoReply(reason=reason_of(error))
        return Reply(status=answer.status_code, headers=dict(answer.headers), body=answer.content)
