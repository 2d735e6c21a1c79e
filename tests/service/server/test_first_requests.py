"""The first requests of a service are not those that pay for what libraries put off."""

import json
import subprocess
import sys
from pathlib import Path

CODE = """
import asyncio, json, sys
from pathlib import Path
from rayfix_service.server.app import create_app
from tests.support.running.running_app import serving

async def calls_of(http):
    count = 0
    def count_calls(frame, event, argument):
        nonlocal count
        count += event == "call"
    sys.setprofile(count_calls)
    await http.post("/v1/positions/unknown")
    sys.setprofile(None)
    return count

async def main():
    async with serving(create_app(Path(sys.argv[1]))) as http:
        there = "anyio._backends._asyncio" in sys.modules
        print(json.dumps([there, await calls_of(http), await calls_of(http)]))

asyncio.run(main())
"""


def test_the_first_request_finds_all_routes_prepared(hall_table_path: Path) -> None:
    """To prepare them and what a long batch needs took 30 ms in which the loop answered nobody."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(hall_table_path)], capture_output=True, text=True, check=True, timeout=600
    )
    has_backend, first, second = json.loads(done.stdout)
    assert has_backend
    assert second > 100
    assert first < 3 * second
