"""One page with a site and its fixes: whole, strict, and safe whatever the texts in it."""

import base64
import hashlib
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rayfix.cli import main
from rayfix.viewing.page import ViewError, inline, read_reports
from rayfix_service.web.assets import load_assets
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table
from tests.support.messages.reports import REPORT


def data_of(page: str) -> dict:
    text = re.search(r'<script type="application/json" id="rayfix-data">(.*?)</script>', page, re.S)
    assert text is not None
    return json.loads(text.group(1))


@pytest.fixture
def built(tmp_path: Path) -> Path:
    """Write a viewer as Vite leaves it, in small."""
    static = tmp_path / "static"
    (static / "assets").mkdir(parents=True)
    (static / "index.html").write_text(
        "<!doctype html><html><head><title>rayfix</title>\n"
        '<script type="module" crossorigin src="./assets/i.js"></script>'
        '\n<link rel="stylesheet" crossorigin href="./assets/i.css">\n</head><body><div id="app"></div></body></html>',
        encoding="utf-8",
    )
    (static / "third-party-licences.md").write_text("three (MIT) -- with its licence", encoding="utf-8")
    (static / "assets" / "i.js").write_text('const a = "</script><!-- \\u0026";', encoding="utf-8")
    (static / "assets" / "i.css").write_text("p { color: red }", encoding="utf-8")
    return static


def test_the_page_is_whole_and_its_policy_fits(built: Path):
    page = inline(built, {"name": "</script><b>&\u2028"}, title="a <b>")
    assert data_of(page) == {"name": "</script><b>&\u2028"}
    assert "src=" not in page
    assert "<link" not in page
    assert "<title>a &lt;b&gt;</title>" in page
    scripts = re.findall(r'<script type="module">(.*?)</script>', page, re.S)
    styles = re.findall(r"<style>(.*?)</style>", page, re.S)
    assert (len(scripts), len(styles)) == (1, 1)
    for name, text in (("script-src", scripts[0]), ("style-src", styles[0])):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{name} &#x27;sha256-{digest}&#x27;" in page
    assert "unsafe" not in page
    assert "<!--\nthree (MIT) - - with its licence-->" in page


def test_without_the_viewer_it_says_what_to_do(tmp_path: Path):
    with pytest.raises(ViewError, match="make viewer"):
        inline(tmp_path, {}, title="")


def test_the_command_writes_the_site_and_the_fix(
    hall_table_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    if not load_assets():
        pytest.skip("the viewer is not built; run make viewer")
    report, page = tmp_path / "report.json", tmp_path / "fix.html"
    report.write_text(json.dumps({"reports": [REPORT, {**REPORT, "target_id": "second"}]}), encoding="utf-8")
    assert main(["view", str(hall_table_path), str(report), "-o", str(page)]) == 0
    assert "2 fixes" in capsys.readouterr().out
    data = data_of(page.read_text(encoding="utf-8"))
    assert [event["fix"]["target_id"] for event in data["events"]] == [REPORT["target_id"], "second"]
    assert data["settings"] == {"simulation": False, "max_reflections": 2, "open_materials": []}
    scene = trimesh.load(io.BytesIO(base64.b64decode(data["scene_base64"])), file_type="glb")
    table = Table.open(hall_table_path)
    size = table.scene.vertices.max(axis=0) - table.scene.vertices.min(axis=0)
    np.testing.assert_allclose(scene.extents, size[[0, 2, 1]], atol=1e-3)
    samples = np.array(data["events"][0]["posterior"]["samples"])
    assert np.all(table.scene.free_space.contains(samples))


def test_reports_are_read_or_refused_with_the_files_name(tmp_path: Path):
    path = tmp_path / "r.json"
    for text in ("[1]", '{"reports": {}}', "{"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ReportError, match=re.escape(str(path))):
            read_reports(path)
    with pytest.raises(ReportError, match="cannot be read"):
        read_reports(tmp_path / "none.json")
