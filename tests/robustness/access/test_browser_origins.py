"""Pages of other origins, and names that point here, get nothing that they should not."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from rayfix_service.http.access.edge import is_same_origin
from rayfix_service.http.access.keys import add_key
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import ServerProcess, start_server

MAPS = "https://maps.example.com"


@pytest.fixture(scope="module")
def local(hall_table_path: Path) -> Iterator[ServerProcess]:
    """Return a service without keys, on loopback."""
    settings = {"cors_origins": [MAPS], "hosts": ["proxy.example.com"]}
    with start_server(hall_table_path, settings=settings) as server:
        yield server


@pytest.fixture(scope="module")
def guarded(hall_table_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[ServerProcess, str]]:
    path = tmp_path_factory.mktemp("secret") / "keys"
    key = add_key(path, "gateway")
    with start_server(hall_table_path, settings={"api_keys": str(path), "cors_origins": [MAPS]}) as server:
        yield server, key


def handshake(server: ServerProcess, origin: str | None, **headers: str) -> int:
    """Open a web socket; 101, or the status of the refusal."""
    named = None if origin is None else Origin(origin)
    try:
        with connect(f"ws://127.0.0.1:{server.port}/v1/stream", origin=named, additional_headers=headers):
            return 101
    except InvalidStatus as refusal:
        return refusal.response.status_code


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "null", "http://127.0.0.1:1", "http://localhost", "file://", ""]
)
def test_a_web_socket_of_another_origin_is_refused(
    local: ServerProcess, guarded: tuple[ServerProcess, str], origin: str
):
    assert handshake(local, origin) == 403
    assert handshake(guarded[0], origin, **{"X-API-Key": guarded[1]}) == 403


def test_a_web_socket_of_the_services_own_pages_and_of_named_origins_opens(
    local: ServerProcess, guarded: tuple[ServerProcess, str]
):
    for origin in (None, MAPS):
        assert handshake(local, origin) == 101
        assert handshake(guarded[0], origin, **{"X-API-Key": guarded[1]}) == 101
    assert handshake(local, f"http://127.0.0.1:{local.port}") == 101
    assert handshake(local, f"https://127.0.0.1:{local.port}") == 101  # of a proxy that ends TLS
    assert handshake(guarded[0], MAPS) == 401


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"origin": MAPS}, 200),
        ({"origin": "http://127.0.0.1:{port}", "sec-fetch-site": "same-origin"}, 200),
        ({"origin": "http://localhost:{port}", "host": "localhost:{port}"}, 200),
        ({"origin": "http://renamed.by.proxy", "sec-fetch-site": "same-origin"}, 200),
        ({"origin": "https://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"origin": "http://localhost:{port}"}, 403),
        ({"sec-fetch-site": "cross-site"}, 403),
        ({"sec-fetch-site": "same-site"}, 403),
        ({"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, 403),
        ({"origin": "https://evil.example", "sec-fetch-site": "cross-site", "content-type": "text/plain"}, 403),
    ],
)
def test_posts_of_other_origins_are_refused_without_keys(local: ServerProcess, headers: dict[str, str], status: int):
    with local.client() as http:
        filled = {name: value.format(port=local.port) for name, value in headers.items()}
        answer = http.post("/v1/positions", json=REPORT, headers=filled)
        assert answer.status_code == status
        assert http.post("/v1/positions?output=native", json=REPORT, headers=filled).status_code == status
    if status == 403:
        assert answer.json()["type"] == "urn:rayfix:problem:forbidden"
        assert "--cors-origin" in answer.json()["detail"]


def test_who_follows_a_link_gets_in_and_an_embedding_page_does_not(local: ServerProcess):
    with local.client() as http:
        link = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
        for path in ("/", "/v1/table", "/docs"):
            assert http.get(path, headers=link).status_code == 200
        embedded = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}
        assert http.get("/v1/fixes", headers=embedded).status_code == 403
        assert http.get("/livez", headers=embedded).status_code == 200


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200),
        ("127.0.0.1:8000", 200),
        ("127.1.2.3:80", 200),
        ("localhost:1234", 200),
        ("LocalHost.", 200),
        ("[::1]:8000", 200),
        ("proxy.example.com", 200),
        ("evil.example", 421),
        ("evil.example:8000", 421),
        ("127.0.0.1.evil.example", 421),
        ("localhost.evil.example", 421),
        ("192.0.2.1", 421),
        ("", 421),
    ],
)
def test_a_name_that_points_here_is_no_name_of_the_service(local: ServerProcess, host: str, status: int):
    with local.client() as http:
        answer = http.get("/v1/table", headers={"host": host})
        assert answer.status_code == status
        if status == 421:
            assert "--allowed-host" in answer.json()["detail"]
            assert handshake_by_name(local, host) == 421


def handshake_by_name(server: ServerProcess, host: str) -> int:
    """Open a web socket as a page does whose own name was made to point here."""
    with server.client() as http:
        headers = {"host": host, "origin": f"http://{host}", "upgrade": "websocket", "connection": "Upgrade"}
        headers |= {"sec-websocket-key": "AAAAAAAAAAAAAAAAAAAAAA==", "sec-websocket-version": "13"}
        return http.get("/v1/stream", headers=headers).status_code


def test_with_keys_any_name_will_do(guarded: tuple[ServerProcess, str]):
    with guarded[0].client() as http:
        headers: dict[str, Any] = {"x-api-key": guarded[1], "host": "anything.example"}
        assert http.get("/v1/table", headers=headers).status_code == 200
        assert http.get("/livez", headers={"host": "10.0.0.7:8000"}).status_code == 200


@pytest.mark.parametrize(
    ("origin", "host", "same"),
    [
        ("https://a.example", "a.example", True),
        ("https://a.example", "a.example:443", True),
        ("https://A.example:443", "a.EXAMPLE", True),
        ("http://a.example:8000", "a.example:8000", True),
        ("http://[::1]:8000", "[::1]:8000", True),
        ("http://a.example", "a.example:8000", False),
        ("http://b.a.example", "a.example", False),
        ("http://a.example", "", False),
        ("http://[::1", "[::1", False),
        ("null", "null", False),
    ],
)
def test_what_is_one_origin(origin: str, host: str, same: bool):
    assert is_same_origin(origin, host) == same
