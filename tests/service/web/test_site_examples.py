"""Examples of the OpenAPI document for tables that are not of the bundled hall: each can be tried out as it stands."""

import json
from pathlib import Path
from typing import Any

import pytest

from rayfix_offline.build import build_table
from tests.support.running.running_app import RunningApp
from tests.support.scenes.rooms import room_with_crate
from tests.support.scenes.sites import stations_text

SITE = """\
[site]
name = "room"
scene = "room.ply"
north_deg = 30.0
[propagation]
max_reflections = 1
max_path_length_m = 20.0
[table]
windows_deg = [6.0, 15.0]
"""


def tried(app: RunningApp) -> dict[str, set[str]]:
    """Try all examples; return the statuses of the fixes by path."""
    found: dict[str, set[str]] = {}
    document: dict[str, Any] = app.get("/openapi.json").json()
    for path, operations in document["paths"].items():
        for media_type, content in operations.get("post", {}).get("requestBody", {}).get("content", {}).items():
            for example in content.get("examples", {}).values():
                value = example["value"]
                data = value if isinstance(value, str) else json.dumps(value)
                response = app.post_bytes(path, data, {"content-type": media_type})
                assert response.status_code == 200, (path, response.text)
                answer = response.json()
                fixes = answer.get("results", [answer.get("fix", answer)])
                found.setdefault(path, set()).update(fix.get("status", "") for fix in fixes)
    return found


@pytest.mark.parametrize("stations", [{"north-wall": (0.4, 0.5)}, {"a": (0.4, 0.5), "b": (3.5, 0.6), "c": (2.0, 4.5)}])
def test_every_example_works_with_other_stations(tmp_path: Path, stations: dict[str, tuple[float, float]]):
    room_with_crate(1.0).export(tmp_path / "room.ply")
    text = SITE + stations_text({name: (x, y, 2.5) for name, (x, y) in stations.items()})
    (tmp_path / "site.toml").write_text(text, encoding="utf-8")
    build_table(tmp_path / "site.toml", tmp_path / "room.h5", jobs=1)
    with RunningApp(tmp_path / "room.h5", simulation=True) as app:
        found = tried(app)
    routes = {"", "/batch", "/nrppa", "/nrppa/batch", "/silabs", "/silabs/batch"}
    assert {f"/v1/positions{route}" for route in routes} <= found.keys()
    for path, statuses in found.items():
        assert "inconsistent" not in statuses, path
        assert not {str(status) for status in statuses} & {"422", "400"}, path
    if len(stations) > 1:
        assert found["/v1/positions/nrppa"] == {"ok"}
