"""Tables in operation: several of a folder, new ones swapped in, bad ones refused."""

import asyncio
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import pytest

from rayfix_service.server.server import serve
from rayfix_tables.errors import TableError
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp
from tests.support.tables.damage import flip_a_bit
from tests.support.tables.table_edits import change_site, sign

POLL = 0.05  # s


def put_table(source: Path, path: Path, site_name: str) -> str:
    """Rename a copy of a table with another name of the site into place; returns its identifier."""
    beside = Path(shutil.copy(source, path.with_suffix(".new")))
    with h5py.File(beside, "r+") as file:
        change_site(file, lambda site: site | {"name": site_name})
        table_id = sign(file)
    os.replace(beside, path)
    return table_id


def put_damaged(source: Path, path: Path) -> None:
    """Rename a copy of a table with one wrong bit into place."""
    beside = Path(shutil.copy(source, path.with_suffix(".new")))
    flip_a_bit(beside, "scene/vertices_m")
    os.replace(beside, path)


def watching(tables: Path, **settings: Any) -> RunningApp:
    """Return an application that often looks at its tables' files."""
    return RunningApp(tables, watch_seconds=POLL, **settings)


def names(service: RunningApp) -> dict[str, str]:
    """Names of sites by those of their tables."""
    return {table["name"]: table["site"]["name"] for table in service.get("/v1/tables").json()["tables"]}


@pytest.fixture
def folder(hall_table_path: Path, tmp_path: Path) -> Path:
    """Return a folder of two tables."""
    put_table(hall_table_path, tmp_path / "ground.h5", "ground floor")
    put_table(hall_table_path, tmp_path / "upper.h5", "upper floor")
    return tmp_path


@pytest.fixture
def service(folder: Path) -> Iterator[RunningApp]:
    with watching(folder) as service:
        yield service


def test_tables_of_a_folder_are_told_apart_by_name(service: RunningApp):
    assert names(service) == {"ground": "ground floor", "upper": "upper floor"}
    ready = service.get("/readyz").json()
    assert [table["name"] for table in ready["tables"]] == ["ground", "upper"]
    for name, table_id in ((table["name"], table["table_id"]) for table in ready["tables"]):
        assert service.post(f"/v1/positions?table={name}", REPORT).json()["table_id"] == table_id
        assert service.get(f"/v1/table?table={name}").json()["table_id"] == table_id
        assert len(service.get(f"/v1/stations?table={name}").json()["stations"]) == 4
    result = service.post("/v1/positions/batch?table=upper", {"reports": [REPORT]}).json()["results"][0]
    assert result["table_id"] == ready["tables"][1]["table_id"]


def test_a_table_must_be_named_where_there_are_several(service: RunningApp):
    for path in ("/v1/table", "/v1/stations"):
        refusal = service.get(path)
        assert refusal.status_code == 422
        assert refusal.json()["errors"] == [{"path": "table", "message": refusal.json()["detail"]}]
        assert "ground, upper" in refusal.json()["detail"]
    assert service.post("/v1/positions", REPORT).status_code == 422
    for path in ("/v1/table?table=attic", "/v1/fixes?table=attic"):
        assert service.get(path).status_code == 404
        assert "'attic'; give one of ground, upper" in service.get(path).json()["detail"]


def test_the_table_named_default_needs_no_name(service: RunningApp, folder: Path, hall_table_path: Path):
    default = put_table(hall_table_path, folder / "default.h5", "default floor")
    assert service.post("/v1/tables/reload").json() == {
        "tables": [
            {"name": "default", "change": "loaded"},
            {"name": "ground", "change": "unchanged"},
            {"name": "upper", "change": "unchanged"},
        ]
    }
    assert service.post("/v1/positions", REPORT).json()["table_id"] == default


def test_a_new_file_is_swapped_in_by_itself(service: RunningApp, folder: Path, hall_table_path: Path):
    for name in ("first", "second"):
        put_table(hall_table_path, folder / "ground.h5", name)
        service.wait_for(lambda name=name: names(service)["ground"] == name)
        assert names(service)["upper"] == "upper floor"
    put_table(hall_table_path, folder / "attic.h5", "attic")
    service.wait_for(lambda: "attic" in names(service))
    figures = service.get("/metrics").text
    assert 'rayfix_table_loads_total{outcome="loaded"} 5.0' in figures
    (now,) = (line for line in figures.splitlines() if 'site="second"' in line)
    (before,) = (line for line in figures.splitlines() if 'site="first"' in line)
    assert now.endswith(" 1.0")
    assert before.endswith(" 0.0")


def test_a_bad_file_is_refused_and_the_old_table_answers(
    service: RunningApp, folder: Path, hall_table_path: Path, caplog: pytest.LogCaptureFixture
):
    put_damaged(hall_table_path, folder / "ground.h5")
    refusal = service.post("/v1/tables/reload")
    assert refusal.status_code == 409
    document = refusal.json()
    assert document["type"] == "urn:rayfix:problem:table-refused"
    assert document["errors"][0]["path"] == "ground"
    assert document["detail"].startswith("ground.h5 is damaged: the checksum of scene/vertices_m does not match")
    assert str(folder) not in refusal.text
    assert str(folder / "ground.h5") in caplog.text
    assert names(service) == {"ground": "ground floor", "upper": "upper floor"}
    assert service.get("/readyz").status_code == 200
    assert service.post("/v1/positions?table=ground", REPORT).status_code == 200
    assert 'rayfix_table_loads_total{outcome="refused"} 1.0' in service.get("/metrics").text
    put_table(hall_table_path, folder / "ground.h5", "mended")
    service.wait_for(lambda: names(service)["ground"] == "mended")


def test_a_bad_file_is_refused_once(service: RunningApp, folder: Path):
    (folder / "new.h5").write_bytes(b"no table")
    figure = 'rayfix_table_loads_total{outcome="refused"} 1.0'
    service.wait_for(lambda: figure in service.get("/metrics").text)
    service.run(asyncio.sleep(5 * POLL))
    assert figure in service.get("/metrics").text
    assert "new" not in names(service)


def test_a_file_that_is_gone_matters_at_the_next_reload(service: RunningApp, folder: Path):
    (folder / "upper.h5").unlink()
    service.run(asyncio.sleep(5 * POLL))
    assert "upper" in names(service)
    assert {"name": "upper", "change": "removed"} in service.post("/v1/tables/reload").json()["tables"]
    assert names(service) == {"ground": "ground floor"}
    # An empty folder is more likely one that is not mounted.
    (folder / "ground.h5").unlink()
    refusal = service.post("/v1/tables/reload")
    assert refusal.status_code == 409
    assert "there is no table in" in refusal.json()["detail"]
    assert str(folder.parent) not in refusal.text
    assert service.get("/v1/table").status_code == 200


def test_other_workers_follow_a_reload(folder: Path, tmp_path: Path):
    runtime = tmp_path / "runtime"
    runtime.mkdir()
    with watching(folder, runtime_folder=runtime) as one, watching(folder, runtime_folder=runtime) as other:
        (folder / "upper.h5").unlink()
        one.post("/v1/tables/reload")
        other.wait_for(lambda: names(other) == {"ground": "ground floor"})


def test_a_worker_that_replaces_another_waits_until_it_can_locate(hall_table_path: Path, tmp_path: Path):
    with (
        watching(hall_table_path, runtime_folder=tmp_path),
        watching(hall_table_path, ready=False, runtime_folder=tmp_path) as replacement,
    ):
        assert replacement.get("/readyz").status_code == 200


def test_no_request_fails_while_tables_are_swapped(hall_table_path: Path, tmp_path: Path):
    path = tmp_path / "hall.h5"
    put_table(hall_table_path, path, "0")
    with watching(path) as service:

        async def ask(answers: list[tuple[int, str]], done: asyncio.Event) -> None:
            while not done.is_set():
                answer = await service.http.post("/v1/positions", json=REPORT)
                answers.append((answer.status_code, answer.json().get("table_id", "")))
                await asyncio.sleep(0)  # nothing here waits for a network

        async def swap() -> list[list[tuple[int, str]]]:
            done = asyncio.Event()
            answers: list[list[tuple[int, str]]] = [[] for _ in range(4)]
            asking = [asyncio.create_task(ask(each, done)) for each in answers]
            for number in range(1, 4):
                identifier = await asyncio.to_thread(put_table, hall_table_path, path, str(number))
                assert (await service.http.post("/v1/tables/reload")).status_code == 200
                async with asyncio.timeout(60.0):  # each is then answered from the new table
                    while not all(each and each[-1][1] == identifier for each in answers):
                        await asyncio.sleep(0.01)
            done.set()
            await asyncio.gather(*asking)
            return answers

        for each in service.run(swap()):
            assert {status for status, _ in each} == {200}


def test_what_cannot_be_served_is_said_at_the_start(folder: Path, hall_table_path: Path, tmp_path: Path):
    for name in ("ground", "upper"):
        put_damaged(hall_table_path, folder / f"{name}.h5")
    with pytest.raises(TableError, match=r"ground\.h5 is damaged"):
        serve(folder)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(TableError, match=r"there is no table in .*empty; put files"):
        serve(empty)
