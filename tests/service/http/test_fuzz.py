"""Whatever is sent, no defect shows: requests made from the OpenAPI document, and bodies that are no requests."""

import asyncio
import json
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rayfix_service.http.openapi.examples import (
    BATCH_EXAMPLES,
    NRPPA_EXAMPLES,
    REPORT_EXAMPLES,
    SILABS_EXAMPLES,
    UBLOX_EXAMPLES,
)
from rayfix_service.server.app import create_app
from rayfix_service.server.openapi import openapi_text
from tests.support.checkout import ROOT
from tests.support.running.server_process import start_server

DOCUMENT = ROOT / "docs" / "openapi.json"

EXAMPLES: dict[str, list[Any]] = {
    path: [example["value"] for example in examples.values()]
    for path, examples in {
        "/v1/positions": REPORT_EXAMPLES,
        "/v1/positions/batch": BATCH_EXAMPLES,
        "/v1/positions/nrppa": NRPPA_EXAMPLES,
        "/v1/positions/silabs": SILABS_EXAMPLES,
        "/v1/positions/ublox": UBLOX_EXAMPLES,
    }.items()
}

STRANGE: list[Any] = [
    None,
    True,
    0,
    -1,
    1.5,
    10**30,
    -1e308,
    5e-324,
    "",
    "\x00",
    "NaN",
    "\ud7ff\uffff",
    [],
    [[]],
    {},
    {"": 0},
    [None] * 300,
    "x" * 5000,
]
PIECES = [
    b"{",
    b"}",
    b"[",
    b"]",
    b",",
    b":",
    b'"',
    b"\\",
    b"\x00",
    b"\xff",
    b"NaN",
    b"1e999",
    b"-",
    b"\\ud800",
    b"\r\n",
]


def test_the_committed_document_is_that_of_the_code():
    assert DOCUMENT.read_text(encoding="utf-8") == openapi_text(), "run 'make openapi' and commit docs/openapi.json"


@pytest.mark.slow
def test_schemathesis_finds_nothing(hall_table_path: Path):
    with start_server(hall_table_path) as server:
        command = [
            Path(sys.executable).with_name("schemathesis"),
            "run",
            f"http://127.0.0.1:{server.port}/openapi.json",
        ]
        checks = ["not_a_server_error", "status_code_conformance", "content_type_conformance"]
        checks += ["response_schema_conformance", "unsupported_method", "allow_header_conformance"]
        options = ["--phases", "examples,fuzzing", "--max-examples", "6", "--seed", "1", "--checks", ",".join(checks)]
        # The feed of fixes never ends.
        options += ["--exclude-path", "/v1/fixes", "--generation-database", "none", "--no-color"]
        run = subprocess.run([*command, *options], capture_output=True, text=True, timeout=300, check=False)
        log = server.stop()
    assert run.returncode == 0, run.stdout
    assert "Traceback" not in log


def mangled(document: Any, chance: random.Random) -> bytes:
    """Break a document at one place, as JSON or as text."""
    text = document.encode() if isinstance(document, str) else None
    if text is None:
        document = json.loads(json.dumps(document))
        if chance.random() < 0.6:
            _spoil(document, chance)
        text = json.dumps(document).encode()
    for _ in range(chance.choice([0, 1, 1, 2, 5])):
        place = chance.randrange(len(text) + 1)
        match chance.randrange(4):
            case 0:
                text = text[:place]
            case 1:
                text = text[:place] + chance.choice(PIECES) + text[place:]
            case 2:
                text = text[:place] + text[place + chance.randrange(1, 9) :]
            case _:
                text = text[:place] + bytes([chance.randrange(256)]) + text[place + 1 :]
    return text


def _spoil(document: Any, chance: random.Random) -> None:
    """Put something strange for a random part of a document."""
    node = document
    while True:
        keys = list(node) if isinstance(node, dict) else range(len(node))
        key = chance.choice(list(keys))
        if not (isinstance(node[key], dict | list) and node[key]) or chance.random() < 0.2:
            break
        node = node[key]
    if chance.random() < 0.2 and isinstance(node, dict):
        node[chance.choice(["", "extra", "\x00", "measurements"])] = chance.choice(STRANGE)
    elif chance.random() < 0.2:
        del node[key]
    else:
        node[key] = chance.choice(STRANGE)


@pytest.mark.slow
def test_ten_thousand_mangled_bodies_break_nothing(hall_table_path: Path):
    app = create_app(hall_table_path)
    chance = random.Random(7)

    async def post(path: str, body: bytes) -> tuple[int, bytes]:
        media_type = b"text/plain" if path.endswith("ublox") else b"application/json"
        scope = {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.3"},
            "http_version": "1.1",
            "method": "POST",
            "scheme": "http",
            "path": path,
            "raw_path": path.encode(),
            "query_string": b"",
            "root_path": "",
            "headers": [(b"content-type", media_type)],
        }
        sent: list[Any] = []

        async def receive() -> Any:
            return {"type": "http.request", "body": body, "more_body": False}

        async def send(message: Any) -> None:
            sent.append(message)

        await app(scope, receive, send)
        return sent[0]["status"], b"".join(message.get("body", b"") for message in sent)

    async def run() -> dict[int, int]:
        count: dict[int, int] = {}
        async with app.router.lifespan_context(app):
            await app.state.services.tables.became_ready.wait()
            for number in range(10_000):
                path = chance.choice(list(EXAMPLES))
                body = mangled(chance.choice(EXAMPLES[path]), chance)
                status, answer = await post(path, body)
                assert status in (200, 400, 422), (number, path, body, answer)
                document = json.loads(answer)
                for result in document.get("results", [document]):
                    assert result.get("status") != 500, (number, path, body)
                count[status] = count.get(status, 0) + 1
        return count

    count = asyncio.run(run())
    assert sum(count.values()) == 10_000
    assert min(count.get(status, 0) for status in (200, 400, 422)) > 100
