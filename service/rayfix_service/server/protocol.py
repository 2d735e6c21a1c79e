"""The server's HTTP protocol: uvicorn's, with buffered writes at the end of an iteration of the event loop.

It also enforces :class:`~rayfix_service.http.settings.ConnectionLimits`, which uvicorn does not have.
"""

import asyncio
import json
from collections.abc import Iterable
from http import HTTPStatus
from typing import Any, cast

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from rayfix_service.http.problems import MEDIA_TYPE, OVERLOADED, problem_document, problem_response
from rayfix_service.http.settings import ConnectionLimits
from rayfix_service.http.telemetry.connections import NOTE, Closed, Crowd

_MOST_HELD = 1 << 16  # bytes; longer data justify a system call, and the flow control must see them

_PIECE = 1 << 16  # bytes that are passed to the parser at a time
_MOST_PIPELINED = 100  # requests of one connection that wait for the answer to an earlier one
_SMALL_REST = 1 << 16  # bytes of an unread body up to which the connection is kept
_LINGER_SECONDS = 2.0  # after the end of a connection, for a client that still sends or has not read everything
_LINGER_BYTES = 32 << 20
_SPARE_SECONDS = 1.0  # for the head of a request, when there are too many connections
_STOP_SECONDS = 3.0  # for requests in progress at shutdown

# Limits of the websockets library.
_WEBSOCKET_LINE = 8000
_WEBSOCKET_FIELDS = 120


class GatheringTransport:
    """A transport that collects all writes of one iteration of the event loop and makes one system call at its end.

    The server writes the head and the body of an answer separately, and uvloop would send each at once. A write that
    wakes the client is slow. At the end of an iteration, which answers all requests that were ready, the client is
    mostly awake already.

    Parameters
    ----------
    transport : asyncio.Transport
        The wrapped transport, which does everything else.
    loop : asyncio.AbstractEventLoop

    Attributes
    ----------
    lingers : bool
        Whether the client is still sending. Closing the socket then could discard an answer that the client has not
        read yet: instead, this side of the connection is shut down, and incoming data are discarded for a short time.
    is_lingering : bool
        Whether this is in progress.
    """

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport = transport
        self._loop = loop
        self._held: list[bytes] = []
        self._length = 0
        self.is_lingering = False
        self.lingers = False

    def __getattr__(self, name: str) -> Any:
        """Forward attributes to the transport."""
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Buffer data until the end of the iteration; flush at once if the buffer is large."""
        if not self._held:
            self._loop.call_soon(self._flush)
        self._held.append(data)
        self._length += len(data)
        if self._length > _MOST_HELD:
            self._flush()

    def writelines(self, pieces: Iterable[bytes]) -> None:
        """Write several pieces."""
        for piece in pieces:
            self.write(piece)

    def write_eof(self) -> None:
        """Flush, and shut down this side of the connection."""
        self._flush()
        self._transport.write_eof()

    def is_closing(self) -> bool:
        """Whether the connection is closed or about to be."""
        return self.is_lingering or self._transport.is_closing()

    def close(self) -> None:
        """Flush and close the connection; abort it if the client has not closed its side within a few seconds."""
        self._flush()
        if self.is_lingering or self._transport.is_closing():
            self._transport.close()
            return
        if self.lingers:
            self.is_lingering = True
            self._transport.write_eof()
            self._transport.resume_reading()
            self._loop.call_later(_LINGER_SECONDS, self._transport.abort)
            return
        if self._transport.get_write_buffer_size():
            self._loop.call_later(_LINGER_SECONDS, self._transport.abort)
        self._transport.close()

    def _flush(self) -> None:
        held, self._held, self._length = self._held, [], 0
        if held and not self.is_closing():
            self._transport.writelines(held)


class _RefusedError(Exception):
    """Ends the parsing of a request."""


class GatheringProtocol(HttpToolsProtocol):
    """HTTP/1.1 by httptools over a :class:`GatheringTransport`, within limits.

    Parameters
    ----------
    *arguments, **options
        Passed to uvicorn's protocol.
    crowd : Crowd, optional
        The connections of this process.
    """

    transport: GatheringTransport  # type: ignore[assignment]

    def __init__(self, *arguments: Any, crowd: Crowd | None = None, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._crowd = crowd or Crowd(ConnectionLimits())
        self._limits = self._crowd.limits
        self._is_spare = False
        self._in_head = False  # a head is partly received
        self._in_body = False  # the head is received, the body not completely
        self._is_gone = False  # closed, or upgraded to a web socket
        self._fed = 0  # bytes of the head in earlier pieces
        self._piece = 0  # bytes of the piece being parsed
        self._began = False  # whether a head began in this piece
        self._has_body = False  # whether this piece had a part of a body
        self._bytes_since_body = 0  # bytes since then: chunk extensions, trailers
        self._lingered = 0
        self._refusal: tuple[int, Closed, str] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._timed = ""
        self._write_timer: asyncio.TimerHandle | None = None

    # --- the connection

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection."""
        super().connection_made(cast("asyncio.Transport", GatheringTransport(transport, self.loop)))
        self._is_spare = self._crowd.enter(self, len(self.connections))
        if self._is_spare:
            self._note("full")
            self.app = cast("Any", _OnlyAlive(cast("ASGIApp", self.app)))
        self._time("head", _SPARE_SECONDS if self._is_spare else self._limits.head_seconds)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self._let_go()
        super().connection_lost(exc)

    def drop(self) -> None:
        """Close the connection at once to make room for another."""
        self._note("full")
        self.transport.abort()

    def shutdown(self) -> None:
        """End the connection after the answer to the current request; slow clients get less time than usual."""
        super().shutdown()
        if self._in_body and not self.transport.is_closing():
            self._time("body", min(_STOP_SECONDS, self._limits.body_seconds))
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = self.loop.call_later(min(_STOP_SECONDS, self._limits.unread_seconds), self._unread)

    # --- incoming data

    def data_received(self, data: bytes) -> None:
        """Parse incoming data in small pieces."""
        if self.transport.is_lingering:
            self._lingered += len(data)
            if self._lingered > _LINGER_BYTES:
                self.transport.abort()
            return
        if len(data) <= _PIECE:
            self._feed(data)
            return
        for start in range(0, len(data), _PIECE):
            self._feed(data[start : start + _PIECE])
            if self._is_gone or self.transport.is_closing():
                return

    def _feed(self, data: bytes) -> None:
        self._piece, self._has_body, self._began = len(data), False, False
        was_in_body = self._in_body
        super().data_received(data)
        if self._is_gone:
            return
        if self._in_body:
            self._after_piece_of_body(was_in_body)
        elif self._in_head:
            if not self._began:
                self._fed += len(data)
                if self._fed > self._limits.head_bytes:
                    self._refuse(431, "head_too_large", self._too_large())
                    return
            if self._timed != "head":
                self._time("head", self._limits.head_seconds)
        elif self._is_answering():  # nearly always: a request is complete
            if self._timer is not None:
                self._untime()
        elif self._timed != "head" and self.timeout_keep_alive_task is None:  # line ends before a request
            self._time("head", self._limits.head_seconds)

    def _after_piece_of_body(self, was_in_body: bool) -> None:
        self._bytes_since_body = 0 if self._has_body else self._bytes_since_body + self._piece
        if was_in_body and self._bytes_since_body > self._limits.head_bytes:
            self._refuse(431, "head_too_large", self._too_large())
            return
        if self._timed == "body":
            return
        self._time("body", self._limits.body_seconds)
        self.transport.lingers = True
        if not self._has_small_body():
            self._close_after_early_answer()

    def _has_small_body(self) -> bool:
        lengths = [value for name, value in self.cycle.scope["headers"] if name == b"content-length"]
        return bool(lengths) and lengths[0].isdigit() and int(lengths[0]) <= _SMALL_REST

    def _close_after_early_answer(self) -> None:
        """End the connection if the answer precedes the end of the body; the answer announces it."""
        cycle, send = self.cycle, self.cycle.send

        async def send_and_close(message: Any) -> None:
            if message["type"] == "http.response.start" and cycle.more_body:
                cycle.keep_alive = False
            await send(message)

        cycle.send = send_and_close  # type: ignore[method-assign]

    # --- parser callbacks

    def on_message_begin(self) -> None:
        """Begin a request."""
        super().on_message_begin()
        self._in_head, self._began, self._fed = True, True, 0

    def on_headers_complete(self) -> None:
        """Begin to answer a request, or refuse its head."""
        if len(self.headers) > self._limits.head_fields:
            self._refusal = (431, "head_too_large", self._too_large())
            raise _RefusedError
        if self._fed + self._piece > self._limits.head_bytes:
            length = len(self.url) + sum(len(name) + len(value) + 4 for name, value in self.headers)
            if length > self._limits.head_bytes:
                self._refusal = (431, "head_too_large", self._too_large())
                raise _RefusedError
        if len(self.pipeline) >= _MOST_PIPELINED:
            self._refusal = (400, "malformed", "there are too many requests before this one; read their answers first")
            raise _RefusedError
        self._in_head, self._in_body = False, True
        self._crowd.work(self)
        super().on_headers_complete()
        if not self.parser.should_upgrade():
            self.headers = []  # trailer fields are not part of the request

    def on_body(self, body: bytes) -> None:
        """Receive a piece of a body."""
        self._has_body = True
        super().on_body(body)

    def on_message_complete(self) -> None:
        """End a request."""
        self._in_body = self.transport.lingers = False
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        if self._is_spare:
            self.transport.close()
        elif not self._is_gone and self.cycle.response_complete:
            self._crowd.wait(self)

    def handle_websocket_upgrade(self) -> None:
        """Upgrade to a web socket."""
        if self._is_spare:
            self._refuse(503, None, "there are too many connections; try again later")
            return
        longest = max((len(name) + len(value) for name, value in self.headers), default=0)
        if max(longest, len(self.url)) > _WEBSOCKET_LINE or len(self.headers) > _WEBSOCKET_FIELDS:
            self._refuse(431, "head_too_large", f"a line is longer than {_WEBSOCKET_LINE} bytes, or there are too many")
            return
        self._let_go()
        super().handle_websocket_upgrade()

    def _is_answering(self) -> bool:
        cycle = self._last_cycle()
        return cycle is not None and not cycle.response_complete

    def _last_cycle(self) -> RequestResponseCycle | None:
        return self.cycle  # None before the first request, unlike its type

    # --- refusals

    def send_400_response(self, msg: str) -> None:
        """Answer a malformed or oversized request."""
        status, reason, text = self._refusal or (400, "malformed", msg)
        self._refusal = None
        self._refuse(status, reason, text)

    def _refuse(self, status: int, reason: Closed | None, text: str) -> None:
        """Answer without calling the application, and close the connection."""
        if reason is not None:
            self._note(reason)
        under_way = self._is_answering()
        if not under_way or (self._in_body and not self.pipeline and not self.cycle.response_started):
            title = HTTPStatus(status).phrase
            document = {"type": "about:blank", "title": title, "status": status, "detail": text, "errors": []}
            body = json.dumps(document).encode()
            head = f"HTTP/1.1 {status} {title}\r\ncontent-type: {MEDIA_TYPE}\r\ncontent-length: {len(body)}\r\n"
            self.transport.write(f"{head}connection: close\r\n\r\n".encode() + body)
        if under_way:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self.transport.lingers = True
        self.transport.close()
        self._let_go()

    def _too_large(self) -> str:
        return (
            f"the head of the request is longer than {self._limits.head_bytes} bytes or has more than "
            f"{self._limits.head_fields} fields; send less"
        )

    # --- timeouts

    def _time(self, what: str, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._timed = self.loop.call_later(seconds, self._is_late, what, seconds), what

    def _untime(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._timed = None, ""

    def _is_late(self, what: str, seconds: float) -> None:
        self._untime()
        if self.transport.is_closing():
            return
        if self.flow.read_paused or (what == "head" and self._is_answering()):
            # The client is not the cause of the delay.
            self._time(what, seconds)
        elif what == "body":
            self._refuse(408, "body_too_slow", f"the body did not come within {seconds:g} s")
        elif self._in_head:
            self._refuse(408, "head_too_slow", f"the head of the request did not come within {seconds:g} s")
        else:
            self._note("head_too_slow")
            self.transport.close()

    def pause_writing(self) -> None:
        """Wait for a limited time until the client reads."""
        super().pause_writing()
        if self._write_timer is None:
            self._write_timer = self.loop.call_later(self._limits.unread_seconds, self._unread)

    def resume_writing(self) -> None:
        """Continue, because the client has read."""
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None

    def _unread(self) -> None:
        self._write_timer = None
        self._note("unread")
        self.transport.abort()

    def _let_go(self) -> None:
        """Hand the connection over to another protocol."""
        self._is_gone = True
        self._crowd.leave(self)
        self._untime()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None

    def _note(self, reason: Closed) -> None:
        self._crowd.note(reason, self.app_state.get(NOTE))


class SocketProtocol(WebSocketsSansIOProtocol):
    """Web sockets; an invalid handshake is refused without a traceback."""

    def handle_parser_exception(self) -> None:
        """Close a connection after data that are not valid frames."""
        if self.conn.close_sent is None:  # within the handshake
            self.transport.write(b"HTTP/1.1 400 Bad Request\r\nconnection: close\r\ncontent-length: 0\r\n\r\n")
            self.transport.close()
            return
        super().handle_parser_exception()


class _OnlyAlive:
    """Answers only ``/livez``, because there are too many connections."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "http" and scope["path"] == "/livez":
            await self._app(scope, receive, send)
            return
        document = problem_document(OVERLOADED, "there are too many connections; try again later")
        await problem_response(document, {"Connection": "close", "Retry-After": "1"})(scope, receive, send)
