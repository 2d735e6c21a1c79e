"""The client for asyncio; ``make client`` generates the blocking one from it."""

from collections.abc import AsyncIterable, AsyncIterator, Callable, Iterable, Mapping
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
    lines_answers,
    lines_call,
    message_call,
    position_call,
    reason_of,
    report_bytes,
    request,
    stream_answer,
)
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
from rayfix.client.waiting import async_connect, async_pause, async_receive
from rayfix.errors import ProblemError, UnreachableError
from rayfix.extras import needs_extra

with needs_extra("client"):
    import httpx

T = TypeVar("T")


class AsyncClient:
    """Sends reports to a service, for asyncio; the methods are those of :class:`~rayfix.client.Client`.

    Parameters
    ----------
    url : str
        Address of the service, such as ``http://localhost:8000``.
    api_key, table, track, timeout, retries
        As in :class:`~rayfix.client.settings.ClientSettings`.
    transport : httpx.AsyncBaseTransport, optional
        Transport of the requests, for tests and special networks.

    Raises
    ------
    ClientError
        When ``url`` is not an address. All methods raise subclasses of it; docs/client.md lists them.
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
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.settings = ClientSettings(
            url=url, api_key=api_key, table=table, track=track, timeout=timeout, retries=retries or RetryPolicy()
        )
        self._random = Random()
        self._http = httpx.AsyncClient(headers=self.settings.headers, timeout=timeout, transport=transport)

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the client."""
        await self.close()

    async def close(self) -> None:
        """Close its connections."""
        await self._http.aclose()

    async def locate(self, report: Mapping[str, Any] | object) -> FixAnswer:
        """Locate one report.

        Parameters
        ----------
        report : Mapping or rayfix.Report
            A mapping has the form of the JSON that ``POST /v1/positions`` takes.

        Raises
        ------
        ReportError
            When a number of a ``rayfix.Report`` is out of its range, before anything is sent.
        """
        return await self._ask(position_call(report, self.settings.position_query), fix_answer)

    async def locate_as(self, report: Mapping[str, Any] | object, output: str) -> dict[str, Any]:
        """Locate one report; returns JSON in an output format of docs/formats.md, such as ``"omlox"``."""
        return await self._ask(position_call(report, self.settings.position_query | {"output": output}), dict)

    async def locate_batch(self, reports: Iterable[Mapping[str, Any] | object]) -> list[FixAnswer | ProblemError]:
        """Locate any number of reports, in as many requests as necessary.

        Returns
        -------
        list of (FixAnswer or ProblemError)
            In the order of the reports. The error of a report that the service cannot use is returned, not raised.

        Raises
        ------
        ReportError
            When a number of a ``rayfix.Report`` is out of its range, before the report is sent.
        """
        answers: list[FixAnswer | ProblemError] = []
        for count, call in batch_calls(reports, self.settings.position_query):
            answers += await self._ask(call, partial(batch_answers, count=count))
        return answers

    async def locate_message(self, message: Mapping[str, Any], message_format: str) -> FixAnswer:
        """Locate one message of another system.

        Parameters
        ----------
        message : Mapping
            Its JSON; see docs/formats.md.
        message_format : {"nrppa", "silabs"}
        """
        return await self._ask(message_call(message, message_format, self.settings.position_query), fix_answer)

    async def locate_messages(
        self, messages: Iterable[Mapping[str, Any]], message_format: str
    ) -> list[FixAnswer | ProblemError]:
        """Locate any number of messages of another system; see :meth:`locate_batch`.

        Parameters
        ----------
        messages : iterable of Mapping
        message_format : {"nrppa", "silabs"}
        """
        answers: list[FixAnswer | ProblemError] = []
        for count, call in batch_calls(messages, self.settings.position_query, message_format):
            answers += await self._ask(call, partial(batch_answers, count=count))
        return answers

    async def locate_lines(
        self,
        lines: str,
        *,
        stations: Mapping[str, str] | None = None,
        height: tuple[float, float] | None = None,
        confidence: float | None = None,
        stdev_deg: float | None = None,
        tails: tuple[float, float] | None = None,
    ) -> list[FixAnswer | ProblemError]:
        """Locate from ``+UUDF`` lines of u-blox anchors: an answer for each transmission of each tag.

        Parameters
        ----------
        lines : str
        stations : Mapping, optional
            Stations by anchor; an anchor that is not in the map is itself a station's identifier.
        height : tuple of 2 floats, m, optional
            Known height of the tags and its standard deviation.
        confidence : float, optional
            Probability that the stated accuracies hold.
        stdev_deg : float, deg, optional
            Standard deviation of the angles, which the lines do not state.
        tails : tuple of 2 floats, optional
            Probability that an angle's error has a wider Gaussian distribution, and the ratio of the two standard
            deviations.
        """
        call = lines_call(
            lines,
            self.settings.position_query,
            stations=stations,
            height=height,
            confidence=confidence,
            stdev_deg=stdev_deg,
            tails=tails,
        )
        return await self._ask(call, lines_answers)

    async def stations(self) -> tuple[StationAnswer, ...]:
        """List the stations that reports may name."""
        return await self._ask(
            Call(method="GET", path="/v1/stations", query=self.settings.table_query), station_answers
        )

    async def table(self) -> TableAnswer:
        """Describe the table that answers reports."""
        return await self._ask(Call(method="GET", path="/v1/table", query=self.settings.table_query), table_answer)

    async def tables(self) -> tuple[TableAnswer, ...]:
        """List all tables of the service."""
        return await self._ask(Call(method="GET", path="/v1/tables"), table_answers)

    async def ready(self) -> bool:
        """Whether the service can locate now; makes one attempt."""
        try:
            await self._drive(request(Call(method="GET", path="/readyz"), dict, NO_RETRIES, self._random))
        except (ProblemError, UnreachableError):
            return False
        return True

    async def fixes(self, target_id: str | None = None) -> AsyncIterator[FixEvent]:
        """Receive the fixes of all clients' reports until the iteration is ended.

        A lost connection is re-established; fixes in between are missed.

        Parameters
        ----------
        target_id : str, optional
            Receive the fixes of this target only.
        """
        query = self.settings.feed_query(target_id)
        feed = Feed(self.settings.retries, self._random)
        while True:
            try:
                async with self._http.stream(
                    "GET", self.settings.base + "/v1/fixes", params=query, timeout=SILENCE_SECONDS
                ) as answer:
                    if answer.status_code == 200:
                        feed.opened()
                        async for line in answer.aiter_lines():
                            event = feed.take(line)
                            if event is not None:
                                yield event
                        seconds = feed.lost("the service closed it")
                    else:
                        seconds = feed.refused(
                            answer.status_code, await answer.aread(), answer.headers.get("retry-after")
                        )
            except httpx.TransportError as error:
                seconds = feed.lost(reason_of(error))
            await async_pause(seconds)

    async def stream(
        self, reports: AsyncIterable[Mapping[str, Any] | object]
    ) -> AsyncIterator[FixAnswer | ProblemError]:
        """Send reports over one web socket, each after the answer to the previous one; yields the answers.

        For one sender of many reports this is faster than requests. A lost connection is not re-established.
        """
        with needs_extra("client"):
            from websockets.exceptions import WebSocketException
        try:
            async with async_connect(self.settings.stream_url, self.settings.headers) as socket:
                async for report in reports:
                    await socket.send(report_bytes(report), text=True)
                    yield stream_answer(await async_receive(socket, self.settings.timeout))
        except (OSError, WebSocketException) as error:
            raise UnreachableError(f"the stream is lost ({reason_of(error)}); is the service still there?") from None

    async def _ask(self, call: Call, parse: Callable[[Any], T]) -> T:
        return await self._drive(request(call, parse, self.settings.retries, self._random))

    async def _drive(self, flow: Flow[T]) -> T:
        reply: Reply | NoReply | None = None
        while True:
            try:
                wanted = flow.send(reply)
            except StopIteration as stop:
                result: T = stop.value
                return result
            reply = None
            if isinstance(wanted, Pause):
                await async_pause(wanted.seconds)
            else:
                reply = await self._send(wanted)

    async def _send(self, call: Call) -> Reply | NoReply:
        try:
            answer = await self._http.request(
                call.method,
                self.settings.base + call.path,
                params=dict(call.query) or None,  # an empty query would remove that of the path
                headers=dict(call.headers),
                content=call.body,
            )
        except httpx.TransportError as error:
            return NoReply(reason=reason_of(error))
        return Reply(status=answer.status_code, headers=dict(answer.headers), body=answer.content)
