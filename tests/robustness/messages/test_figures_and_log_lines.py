"""What a client sends cannot spoil the figures or forge the log."""

import io
import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from rayfix_service.http.telemetry.logs import TextFormatter, log_config
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp
from tests.support.running.server_process import start_server

LINE = re.compile(r"INFO: +\S+ \S+ (\d{3}|none) in \d+\.\d ms, request \S+")


@pytest.fixture(scope="module")
def app(hall_table_path: Path) -> Iterator[RunningApp]:
    with RunningApp(hall_table_path) as app:
        yield app


def test_web_sockets_are_counted(hall_table_path: Path, tmp_path: Path):
    with start_server(hall_table_path) as server, server.client() as http:
        url = f"ws://127.0.0.1:{server.port}/v1"
        with connect(f"{url}/stream") as socket:
            assert socket.response is not None
            assert socket.response.headers["x-request-id"]
            for text in (json.dumps(REPORT), "{}", "x" * (3 << 19)):  # the last one is too long to be read
                socket.send(text)
                json.loads(socket.recv())
            for path, origin in (("/stream?output=morse", ""), ("/nothing", ""), ("/stream", "https://evil.example")):
                with pytest.raises(InvalidStatus) as refusal:
                    connect(f"{url}{path}", additional_headers={"Origin": origin} if origin else {})
                assert origin == "" or refusal.value.response.headers["x-request-id"]
            figures = http.get("/metrics").text
    assert 'rayfix_reports_total{outcome="answered",source="stream"} 1.0' in figures
    assert 'rayfix_reports_total{outcome="refused",source="stream"} 2.0' in figures
    for route, status in (("/v1/stream", 101), ("/v1/stream", 422), ("none", 403)):
        found = re.findall(
            rf'rayfix_http_requests_total{{method="GET",route="{route}",status="{status}"}} (\S+)', figures
        )
        assert [float(value) for value in found] == [2.0 if status == 403 else 1.0], (route, status)


@pytest.mark.parametrize(
    "path",
    [
        "/x%0aINFO:     GET /v1/table 200 in 1.0 ms, request forged",
        "/x 200 in 1.0 ms, request forged",
        "/x%0d%1b[2K",
        "/x%e2%80%a8y%c2%85z",
    ],
)
def test_a_line_of_the_access_log_is_one_line(app: RunningApp, path: str, capsys: pytest.CaptureFixture[str]):
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(TextFormatter("%(levelprefix)s %(message)s", use_colors=False))
    logger = logging.getLogger("rayfix_service.access")
    logger.addHandler(handler)
    level = logger.level
    logger.setLevel(logging.INFO)
    try:
        app.get(path.replace(" ", "%20"))
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
    (line,) = stream.getvalue().splitlines()
    assert LINE.fullmatch(line)


def test_any_message_is_one_line_of_text():
    formatter = TextFormatter("%(levelprefix)s %(message)s", use_colors=False)
    text = "table a\nINFO: b\x1b[31m \u2028 \u202e caf\u00e9"
    record = logging.LogRecord("x", logging.INFO, "", 1, "refused: %s", (text,), None)
    assert formatter.format(record) == "INFO:     refused: table a\\nINFO: b\\x1b[31m \\u2028 \\u202e caf\u00e9"
    assert log_config("text", access_log=False)["formatters"]["default"]["()"].endswith("TextFormatter")


def test_a_line_of_text_has_its_time():
    form = log_config("text", access_log=False)["formatters"]["default"]["fmt"]
    record = logging.LogRecord("x", logging.WARNING, "", 1, "text", (), None)
    record.created = 1769853600.25
    assert TextFormatter(form, use_colors=False).format(record) == "2026-01-31T10:00:00.250Z WARNING:  text"


@pytest.mark.parametrize(
    "accept",
    [
        "application/openmetrics-text;version=x",
        "text/plain;version=1.x",
        "text/plain;version=1.0.0.0.a",
        "application/openmetrics-text;version=1\xe9",
        "application/openmetrics-text;version=",
        "application/openmetrics-text;version=999999999999999999999999",
        "application/openmetrics-text;version==1.0.0;escaping=\xff",
        ";;;,,,===",
        "",
    ],
)
def test_an_odd_accept_header_gets_figures(app: RunningApp, accept: str):
    answer = app.get("/metrics", headers={"accept": accept.encode("latin-1")})
    assert answer.status_code == 200
    assert "rayfix_ready 1.0" in answer.text
    assert answer.headers["content-type"].startswith(("text/plain", "application/openmetrics-text"))


@pytest.mark.parametrize("version", ["1.0.0", "0.0.1"])
def test_openmetrics_is_still_there_for_who_asks(app: RunningApp, version: str):
    accept = f"application/openmetrics-text;version={version};q=0.5,text/plain;version=0.0.4;q=0.2,*/*;q=0.1"
    answer = app.get("/metrics", headers={"accept": accept})
    assert answer.headers["content-type"].startswith("application/openmetrics-text") == (version == "1.0.0")
