"""No spelling of a path gets past the access control: guard, router and short way see the same path."""

import asyncio
import random
import re
import socket
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from rayfix_service.http.access.keys import add_key
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.server.app import create_app
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp
from tests.support.running.server_process import start_server

GUARDED = [
    "/metrics",
    "/v1/positions",
    "/v1/positions/batch",
    "/v1/positions/ublox",
    "/v1/table",
    "/v1/tables",
    "/v1/tables/reload",
    "/v1/stations",
    "/v1/stations/bs1/coverage",
    "/v1/fixes",
    "/v1/stream",
    "/v1/scene.glb",
    "/v1/viewer",
    "/v1/simulations",
]
OPEN = ["/", "/livez", "/readyz", "/docs", "/openapi.json"]
OPEN_FOLDERS = ("/assets/", "/interface/")
METHODS = ["GET", "GET", "GET", "POST", "POST", "HEAD", "OPTIONS", "PUT", "DELETE", "PATCH", "TRACE", "PROPFIND", "get"]
ENDS = [
    "%0a",
    "%0d",
    "%0d%0a",
    "%00",
    "%20",
    "%09",
    "%0b",
    "%0c",
    "%85",
    "%c2%85",
    "%e2%80%a8",
    "%1c",
    "%2f",
    "/",
    "//",
]
ENDS += [
    "/.",
    "/..",
    "/./",
    "%2e",
    ".",
    ";",
    ";x=1",
    ";/..",
    "%3b",
    "%3f",
    "%23",
    "#a",
    "?",
    "?a=%0a",
    "%",
    "%zz",
    "\\",
]


def fuzzed(rng: random.Random) -> str:
    """Return a request target: a path of the service, damaged in up to three ways."""
    path = rng.choice(GUARDED if rng.random() < 0.8 else OPEN)
    for _ in range(rng.choice((0, 1, 1, 1, 2, 2, 3))):
        place = rng.randrange(len(path) + 1)
        before, after = path[:place], path[place:]
        path = rng.choice(
            [
                path + rng.choice(ENDS),
                before + rng.choice(ENDS) + after,
                path.replace("/", rng.choice(["//", "/./", "/x/../", "%2f", "\\", "/%2e%2e/", "/;/"]), 1),
                "".join(rng.choice((c.upper(), c)) for c in path),
                before + "".join(f"%{ord(c) % 256:02x}" for c in after[:3]) + after[3:],
                rng.choice(["", "/", "/assets/..", "/assets/%2e%2e", "/livez/..", "http://h", "//h"]) + path,
                rng.choice(["*", "", " ", "%"]) if rng.random() < 0.1 else path[1:],
                before + chr(rng.choice([0, 10, 13, 127, 133, 0x2028, 0xFFFD])) + after,
            ]
        )
    return path


def path_of(target: str) -> str:
    """Return the path of a request target as the server reads it."""
    path = re.sub(r"\A[A-Za-z]+://[^/?#]*", "", target)
    return unquote(path.partition("?")[0].partition("#")[0])


async def status_of(app: Any, kind: str, method: str, target: str) -> int:
    """Return the status that a request without a key is answered with, its path read as the server reads it."""
    _, _, query = target.partition("?")
    scope: dict[str, Any] = {
        "type": kind,
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "scheme": "http",
        "server": ("127.0.0.1", 8000),
        "client": ("127.0.0.1", 50000),
        "root_path": "",
        "path": path_of(target),
        "raw_path": target.partition("?")[0].encode(),
        "query_string": query.encode(),
        "headers": [(b"host", b"127.0.0.1:8000"), (b"content-type", b"application/json")],
        "state": {},
    }
    if kind == "websocket":
        scope |= {"subprotocols": [], "extensions": {"websocket.http.response": {}}}
    else:
        scope["method"] = method
    statuses: list[int] = []
    first = {"type": "websocket.connect"} if kind == "websocket" else {"type": "http.request", "body": b"{}"}
    incoming = [first]

    async def receive() -> Any:
        if incoming:
            return incoming.pop()
        return {"type": "websocket.disconnect" if kind == "websocket" else "http.disconnect"}

    async def send(message: Any) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            statuses.append(message["status"])
        elif message["type"] == "websocket.accept":
            statuses.append(101)
        elif message["type"] == "websocket.close" and not statuses:
            statuses.append(403)

    await app(scope, receive, send)
    return statuses[0]


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    path = tmp_path_factory.mktemp("secret") / "keys"
    return path, add_key(path, "gateway")


@pytest.fixture(scope="module")
def guarded(hall_table_path: Path, keys: tuple[Path, str]) -> Iterator[RunningApp]:
    with RunningApp(hall_table_path, api_keys=keys[0]) as app:
        yield app


def is_on_the_open_list(target: str) -> bool:
    path = path_of(target)
    return path in OPEN or path.startswith(OPEN_FOLDERS)


@pytest.mark.parametrize("end", ["%0a", "\n", "%0d", "%0d%0a", "%00", "/", "%2f", ";x", "%85", "%e2%80%a8"])
@pytest.mark.parametrize("path", ["/metrics", "/v1/table", "/v1/positions"])
def test_a_path_with_something_at_its_end_is_another(guarded: RunningApp, path: str, end: str):
    """The router took a line's end for the end of the path, and the access control did not."""
    assert guarded.run(status_of(guarded.http._transport.app, "http", "GET", path + end)) in (401, 404)  # type: ignore[attr-defined]


def test_of_20000_request_lines_none_gets_in_without_a_key(guarded: RunningApp):
    rng = random.Random(20261101)
    app = guarded.http._transport.app  # type: ignore[attr-defined]

    async def ask() -> Counter[tuple[bool, int]]:
        counts: Counter[tuple[bool, int]] = Counter()
        for _ in range(20_000):
            kind = "websocket" if rng.random() < 0.1 else "http"
            method, target = rng.choice(METHODS), fuzzed(rng)
            status = await status_of(app, kind, method, target)
            opened = is_on_the_open_list(target)
            if not opened:
                assert status in (401, 404), (kind, method, target, status)
            counts[opened, status] += 1
        return counts

    counts = guarded.run(ask())
    # What would have been a way in was among them, and what is open is.
    assert counts[False, 401] > 3000
    assert counts[False, 404] > 3000
    assert counts[True, 200] > 150


def test_every_route_is_open_or_asks_for_a_key(guarded: RunningApp, keys: tuple[Path, str]):
    """What is not on the open list is closed, whether it is there or not."""
    document = guarded.get("/openapi.json").json()
    closed = [path for path, operations in document["paths"].items() for o in operations.values() if "security" in o]
    assert {*document["paths"]} - {*closed} == {"/livez", "/readyz"}
    for path in (*GUARDED, "/nothing", "/admin", "/favicon.ico", "/v2/positions", "/V1/table", "/metricsx"):
        assert guarded.get(path).status_code == 401, path
    header = {"x-api-key": keys[1]}
    assert guarded.get("/nothing", headers=header).status_code == 404
    assert guarded.get("/metrics", headers=header).status_code == 200
    assert guarded.get("/metrics%0a", headers=header).status_code == 404
    assert guarded.post("/v1/positions", REPORT, headers=header).status_code == 200


def test_over_a_real_connection_too(hall_table_path: Path, keys: tuple[Path, str]):
    """The server's parser between: what it refuses is refused, and what it lets through gets no further."""
    rng = random.Random(5)
    counts: Counter[int] = Counter()
    with start_server(hall_table_path, settings={"api_keys": str(keys[0])}) as server:
        targets = [
            "/metrics%0a",
            "/metrics",
            "http://127.0.0.1/metrics",
            "/v1/table%0A",
            *(fuzzed(rng) for _ in range(300)),
        ]
        for target in filter(re.compile("[!-~]+").fullmatch, targets):
            method = "GET" if target in targets[:4] else rng.choice(METHODS)
            with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
                head = (
                    f"{method} {target} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
                )
                connection.sendall(head.encode())
                status = int(connection.recv(1 << 16).split(b" ")[1])
            if not is_on_the_open_list(target):
                assert status in (400, 401, 404), (method, target, status)
            counts[status] += 1
        log = server.stop()
    assert counts[401] > 50
    assert counts[404] > 20
    assert "Traceback" not in log


def test_an_application_that_has_not_started_closes_the_same_paths(hall_table_path: Path):
    app = create_app(hall_table_path, ServiceSettings())
    for path, status in (("/metrics\n", 404), ("/metrics/", 404), ("/livez", 200)):
        assert asyncio.run(status_of(app, "http", "GET", path)) == status
