"""Random valid reports and malformed messages, few of those that ``benchmarks.robustness.reports`` sends."""

from pathlib import Path

from benchmarks.robustness.reports import Found, Source, judge
from rayfix_service.locator import Locator
from rayfix_tables.table import Table
from tests.support.running.running_app import RunningApp


def test_random_requests_get_sound_answers(hall_table_path: Path):
    table = Table.open(hall_table_path)
    source = Source(Locator(table), seed=1, valid_share=0.5, slow_share=0.1)
    found = Found()
    with RunningApp(hall_table_path) as app:
        for number in range(400):
            request = source.request(number)
            headers = {"content-type": "text/plain" if request.path.endswith("ublox") else "application/json"}
            answer = app.post_bytes(request.path, request.body, headers)
            judge(request, answer.status_code, answer.content, table.scene.free_space, found)
    assert found.faults == []
    assert {status for _, status in found.statuses} == {200, 400, 422}
    assert found.slow > 5
    assert set(found.fixes) == {"ok", "ambiguous", "inconsistent", "insufficient"}
