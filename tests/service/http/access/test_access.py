"""Who may use the service: keys, rates, origins, and the limit on slow fixes."""

import asyncio
import math
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from rayfix.cli import main
from rayfix_service.http.access.keys import ApiKeys, add_key
from rayfix_service.http.access.rates import RateLimit
from rayfix_service.http.errors import ServiceError
from rayfix_service.locator import Locator
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp
from tests.support.running.server_process import start_server

RANGES = {"measurements": [{"type": "pt", "station_id": "bs1", "range_m": 7.8, "stdev_m": 0.5}]}


def post(app: RunningApp, document: Any = REPORT, **options: Any) -> httpx.Response:
    """POST the example report, or something else, as JSON."""
    return app.post("/v1/positions", document, **options)


# --- keys ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a key file and one of its two keys."""
    path = tmp_path_factory.mktemp("secret") / "keys"
    key = add_key(path, "gateway")
    add_key(path, "other")
    return path, key


@pytest.fixture(scope="module")
def guarded(hall_table_path: Path, keys: tuple[Path, str]) -> Iterator[RunningApp]:
    with RunningApp(hall_table_path, api_keys=keys[0]) as service:
        yield service


@pytest.mark.parametrize("scheme", ["Bearer {}", "bearer  {}", None])
def test_a_key_opens(guarded: RunningApp, keys: tuple[Path, str], scheme: str | None):
    headers = {"x-api-key": keys[1]} if scheme is None else {"authorization": scheme.format(keys[1])}
    assert post(guarded, headers=headers).status_code == 200
    assert guarded.request("GET", "/v1/tables", headers=headers).status_code == 200
    assert guarded.request("GET", "/metrics", headers=headers).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"x-api-key": ""},
        {"x-api-key": "rfx_wrong"},
        {"authorization": "Bearer"},
        {"authorization": "Basic Zm9vOmJhcg=="},
        {"authorization": "Bearer caf\u00e9".encode("latin-1")},
    ],
)
@pytest.mark.parametrize(
    ("method", "path"), [("POST", "/v1/positions"), ("GET", "/v1/fixes"), ("GET", "/v1/nothing"), ("GET", "/metrics")]
)
def test_without_a_key_all_is_closed(guarded: RunningApp, method: str, path: str, headers: Any):
    refusal = guarded.request(method, path, headers=headers)
    assert refusal.status_code == 401
    assert refusal.headers["www-authenticate"] == "Bearer"
    assert refusal.headers["content-type"] == "application/problem+json"
    assert refusal.json()["type"] == "urn:rayfix:problem:unauthorized"
    assert refusal.headers["x-request-id"]


def test_a_hash_is_no_key(guarded: RunningApp, keys: tuple[Path, str]):
    for line in keys[0].read_text().splitlines():
        for key in (line, *line.split(":")):
            assert post(guarded, headers={"x-api-key": key}).status_code == 401


@pytest.mark.parametrize("path", ["/livez", "/readyz", "/docs", "/openapi.json"])
def test_health_and_documentation_are_open(guarded: RunningApp, path: str):
    assert guarded.request("GET", path).status_code == 200


def test_a_key_in_a_query_is_none(guarded: RunningApp, keys: tuple[Path, str]):
    assert guarded.post(f"/v1/positions?api_key={keys[1]}&key={keys[1]}", REPORT).status_code == 401


def test_keys_are_kept_as_hashes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "keys"
    path.write_text("# gateways", encoding="utf-8")
    made = []
    for name in ("a", "b"):
        assert main(["api-key", name, "-o", str(path)]) == 0
        made.append(capsys.readouterr().out.strip())
    assert not any(key in path.read_text() for key in made)
    keys = ApiKeys(path)
    assert [keys.name_of(key) for key in (*made, "", "rfx_")] == ["a", "b", None, None]
    for name in ("a", "two words", "a:b", ""):
        assert main(["api-key", name, "-o", str(path)]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(ServiceError, match="cannot be written"):
        add_key(tmp_path / "no" / "folder", "a")
    fresh = tmp_path / "fresh"
    add_key(fresh, "a")
    assert fresh.stat().st_mode & 0o077 == 0


def test_a_changed_key_file_is_read_again(hall_table_path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = tmp_path / "keys"
    old = add_key(path, "old")
    with RunningApp(hall_table_path, api_keys=path, watch_seconds=0.02) as service:

        def opens(key: str) -> bool:
            service.run(asyncio.sleep(0.1))
            return post(service, headers={"x-api-key": key}).status_code == 200

        path.write_text("nonsense", encoding="utf-8")
        assert opens(old)
        assert caplog.text.count("keys not read again") == 1
        path.unlink()
        new = add_key(path, "new")
        assert opens(new)
        assert not opens(old)


def test_streams_need_a_key_too(hall_table_path: Path, keys: tuple[Path, str]):
    with start_server(hall_table_path, settings={"api_keys": str(keys[0])}) as server:
        url = f"ws://127.0.0.1:{server.port}/v1/stream"
        with pytest.raises(InvalidStatus) as refusal:
            connect(url)
        assert refusal.value.response.status_code == 401
        with connect(url, additional_headers={"Authorization": f"Bearer {keys[1]}"}) as socket:
            assert socket.subprotocol is None
        # A browser can send no header, but subprotocols, of which the server must choose one.
        offered = [Subprotocol("rayfix"), Subprotocol(f"rayfix.key.{keys[1]}")]
        with connect(url, subprotocols=offered) as socket:
            assert socket.subprotocol == "rayfix"
            socket.send("{")
            assert '"status":400' in socket.recv()
        log = server.stop()
    assert keys[1] not in log


# --- rates -----------------------------------------------------------------------------------------------


def test_a_bucket_empties_and_fills():
    now = 100.0
    limit = RateLimit(2.0, 4.0, clock=lambda: now)
    for _ in range(4):
        assert limit.seconds_to_wait("a") == 0.0
        limit.charge("a")
    assert limit.seconds_to_wait("a") == 0.5
    assert limit.seconds_to_wait("b") == 0.0
    limit.charge("b", 10)  # a batch may make debts
    assert limit.seconds_to_wait("b") == 3.5
    now += 0.5
    assert limit.seconds_to_wait("a") == 0.0
    assert limit.seconds_to_wait("b") == 3.0
    now += 1000.0
    for client in ("a", "b"):
        limit.charge(client, 4)
        assert limit.seconds_to_wait(client) == 0.5


def test_each_client_has_an_account_of_its_own():
    """As long as there is room; with many more clients than places, some share, and all are still limited."""
    limit = RateLimit(2.0, 4.0, clock=lambda: 100.0)
    for count, some_share in ((200, False), (20_000, True)):
        names = [f"{count} {n}" for n in range(count)]
        for n, name in enumerate(names):
            limit.charge(name, 3 + n % 5)
        waits = [limit.seconds_to_wait(name) for name in names]
        expected = [0.5 * (n % 5) for n in range(count)]
        assert (waits != expected) == some_share
        if not some_share:
            assert sorted(set(waits)) == [0.0, 0.5, 1.0, 1.5, 2.0]


def test_a_full_bucket_leaves_its_place():
    """What all places knew of is forgotten once it no longer counts."""
    now = 100.0
    limit = RateLimit(2.0, 4.0, clock=lambda: now)
    for n in range(20_000):
        limit.charge(f"old {n}", 4)
    now += 20_000.0
    for n in range(200):
        limit.charge(f"new {n}", 4)
    assert {limit.seconds_to_wait(f"new {n}") for n in range(200)} == {0.5}
    assert {limit.seconds_to_wait(f"old {n}") for n in range(200)} == {0.0}


def test_forked_processes_share_accounts():
    script = """
        import os
        from rayfix_service.http.access.rates import RateLimit
        limit = RateLimit(2.0, 4.0, clock=lambda: 100.0)
        limit.charge("a", 3)
        for _ in range(3):
            if not os.fork():
                limit.charge("a", 2)
                limit.charge("b")
                os._exit(0)
            os.wait()
        print(limit.seconds_to_wait("a"), limit.seconds_to_wait("b"), limit.seconds_to_wait("c"))
        """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3.0", "0.0", "0.0"]


def test_each_key_has_its_rate(hall_table_path: Path, tmp_path: Path):
    path = tmp_path / "keys"
    a, b = ({"x-api-key": add_key(path, name)} for name in "ab")
    with RunningApp(hall_table_path, api_keys=path, reports_per_second=0.01, burst_seconds=300.0) as service:
        statuses = [post(service, headers=a).status_code for _ in range(4)]
        assert statuses == [200, 200, 200, 429]
        refusal = post(service, headers=a)
        assert refusal.json()["type"] == "urn:rayfix:problem:too-many-requests"
        assert 90 <= int(refusal.headers["retry-after"]) <= 100
        assert service.request("GET", "/v1/table", headers=a).status_code == 200
        # A batch is its reports.
        batch = service.post("/v1/positions/batch", {"reports": [REPORT] * 3}, headers=b)
        assert batch.status_code == 200
        assert post(service, headers=b).status_code == 429


# --- origins ---------------------------------------------------------------------------------------------


def test_other_origins_are_closed_unless_named(hall_table_path: Path, keys: tuple[Path, str], guarded: RunningApp):
    origin = {"origin": "https://maps.example.com"}
    asking = origin | {"access-control-request-method": "POST", "access-control-request-headers": "authorization"}
    assert "access-control-allow-origin" not in guarded.request("GET", "/livez", headers=origin).headers
    assert guarded.request("OPTIONS", "/v1/positions", headers=asking).status_code == 401
    with RunningApp(hall_table_path, api_keys=keys[0], cors_origins=(origin["origin"],)) as service:
        allowed = service.request("OPTIONS", "/v1/positions", headers=asking)
        assert allowed.status_code == 200
        assert allowed.headers["access-control-allow-origin"] == origin["origin"]
        assert "authorization" in allowed.headers["access-control-allow-headers"].lower()
        refusal = post(service, headers=origin)
        assert (refusal.status_code, refusal.headers["access-control-allow-origin"]) == (401, origin["origin"])
        other = service.request("OPTIONS", "/v1/positions", headers=asking | {"origin": "https://evil.example"})
        assert "access-control-allow-origin" not in other.headers


# --- slow fixes ------------------------------------------------------------------------------------------


def test_slow_fixes_are_bounded_and_fast_ones_go_on(hall_table_path: Path, monkeypatch: pytest.MonkeyPatch):
    gate = threading.Event()
    locate = Locator.fuse

    def wait_and_locate(self: Locator, report: Any, *, stop: Any, **more: Any) -> Any:
        if threading.current_thread().name.startswith("slow-fix"):
            gate.wait(30)
            return locate(self, report, stop=stop, **more)
        return locate(self, report, **more)  # not stopped on the event loop, however busy the machine is

    settings = {"slow_fix_threads": 1, "slow_fixes_waiting": 1, "fix_seconds": 0.3, "quick_fix_seconds": 0.0021}
    with RunningApp(hall_table_path, **settings) as service:
        monkeypatch.setattr(Locator, "fuse", wait_and_locate)

        async def together() -> list[httpx.Response]:
            slow = [asyncio.create_task(service.http.post("/v1/positions", json=RANGES)) for _ in range(2)]
            await asyncio.sleep(0.05)
            fast = await service.http.post("/v1/positions", json=REPORT)
            full = await service.http.post("/v1/positions", json=RANGES)
            batch = await service.http.post("/v1/positions/batch", json={"reports": [RANGES, REPORT]})
            return [fast, full, batch, *await asyncio.gather(*slow)]

        fast, full, batch, *late = service.run(together())
        assert fast.status_code == 200
        assert full.status_code == 503
        assert full.json()["type"] == "urn:rayfix:problem:overloaded"
        assert full.headers["retry-after"] == "1"
        assert [result["status"] for result in batch.json()["results"]] == [503, "ok"]
        assert [answer.status_code for answer in late] == [504, 504]
        assert "longer than 0.3 s" in late[0].json()["detail"]
        # What was given up ends, and leaves its place.
        gate.set()
        answers = []
        for _ in range(100):
            answers.append(post(service, RANGES).status_code)
            if answers[-1] == 200:
                break
            service.run(asyncio.sleep(0.02))
        assert answers[-1] == 200


def test_the_pool_changes_no_fix(hall_table_path: Path):
    with RunningApp(hall_table_path) as service:
        angle = REPORT["measurements"][0]
        fixes = [post(service, RANGES).json() for _ in range(2)]
        long = post(service, {"measurements": [angle | {"azimuth_deg": 29.9 + 0.01 * n} for n in range(17)]}).json()
    assert fixes[0]["position"] == fixes[1]["position"]
    distance = math.dist(fixes[0]["position"].values(), (0.1, 0.1, 2.4))
    assert distance < 7.8 + 3 * 0.5
    assert len(long["measurements"]) == 17
