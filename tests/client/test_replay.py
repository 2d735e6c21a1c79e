"""A log is played to a service in its own time, and recorded from its feed."""

import io
import json
import threading
from pathlib import Path
from typing import Any

import pytest

from rayfix.client import Client
from rayfix.logs.reading import Reading
from rayfix.logs.replay import record_reports, replay_logs


def document(seconds: float, station: str = "bs1") -> dict[str, Any]:
    return {
        "target_id": "replayed",
        "timestamp": f"2026-01-31T10:00:{seconds:05.2f}Z",
        "measurements": [
            {"type": "aoa", "station_id": station, "azimuth_deg": 41.2, "azimuth_stdev_deg": 2.0},
            {"type": "pt", "station_id": station, "range_m": 7.9, "stdev_m": 0.5},
        ],
    }


class Clock:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 5.0
        self.slept: list[float] = []

    def __call__(self) -> float:
        """Tell the time."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Move on."""
        self.slept.append(seconds)
        self.now += seconds


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.jsonl"
    lines = [json.dumps(document(s)) for s in (0.0, 0.01, 2.0, 2.5)] + ["{oops", json.dumps(document(3.0, "nowhere"))]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_reports_keep_their_distances(service_url: str, log: Path) -> None:
    clock = Clock()
    with Client(service_url) as client:
        found = replay_logs([log], client, reading=Reading(), speed=2.0, clock=clock, sleep=clock.sleep)
    assert (found.sent, found.fixes, found.refused, found.problems) == (5, 4, 1, 1)
    assert clock.slept == pytest.approx([1.0, 0.25, 0.25], abs=1e-6)


def test_what_is_replayed_can_be_recorded(service_url: str, log: Path) -> None:
    file = io.BytesIO()
    with Client(service_url) as listener, Client(service_url) as sender:
        counts: list[int] = []
        events = listener.fixes("replayed")
        thread = threading.Thread(target=lambda: counts.append(record_reports(events, file, most=4)))
        thread.start()
        for _ in range(100):
            # The feed tells of what comes after it was opened.
            replay_logs([log], sender, reading=Reading(), speed=float("inf"))
            thread.join(0.2)
            if not thread.is_alive():
                break
        assert counts == [4]
    recorded = [json.loads(line) for line in file.getvalue().splitlines()]
    sent = [document(s) for s in (0.0, 0.01, 2.0, 2.5)]
    assert all(each["target_id"] == "replayed" for each in recorded)
    assert {each["timestamp"] for each in recorded} <= {each["timestamp"] for each in sent}
    assert recorded[0]["measurements"] == sent[0]["measurements"]
