"""An open web socket answers from the table that is served now."""

import json
import shutil
from pathlib import Path

import httpx
from websockets.sync.client import connect

from rayfix_offline.build import build_table
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import start_server


def test_an_open_stream_follows_the_table(hall_site_path: Path, hall_table_path: Path, tmp_path: Path):
    """The stations of the new table stand elsewhere, so that the same report has another answer."""
    text = hall_site_path.read_text(encoding="utf-8")
    folder, tables = tmp_path / "site", tmp_path / "tables"
    shutil.copytree(hall_site_path.parent, folder)
    tables.mkdir()
    shutil.copy(hall_table_path, tables / "hall.h5")
    shutil.copy(hall_table_path, tables / "other.h5")
    site = folder / hall_site_path.name
    site.write_text(text.replace('id = "bs1"', 'id = "bs9"'), encoding="utf-8")
    assert site.read_text() != text
    build_table(site, tmp_path / "new.h5")
    report = json.dumps(REPORT)
    assert '"bs1"' in report
    with start_server(tables) as server, server.client() as http:
        with connect(f"ws://127.0.0.1:{server.port}/v1/stream?table=hall") as socket:

            def ask() -> dict[str, object]:
                socket.send(report)
                return dict(json.loads(socket.recv(timeout=30)))

            assert ask()["status"] == "ok"
            (tmp_path / "new.h5").replace(tables / "hall.h5")
            assert http.post("/v1/tables/reload", timeout=60).status_code == httpx.codes.OK
            moved = ask()
            assert moved["status"] == 422
            assert "bs1" in str(moved["detail"])
            (tables / "hall.h5").unlink()
            assert http.post("/v1/tables/reload", timeout=60).status_code == httpx.codes.OK
            gone = ask()
            assert gone["status"] == 404
            assert "there is no table 'hall'; give one of other" in str(gone["detail"])
            shutil.copy(hall_table_path, tables / "hall.h5")
            assert http.post("/v1/tables/reload", timeout=60).status_code == httpx.codes.OK
            assert ask()["status"] == "ok"
        assert "Traceback" not in server.stop()
