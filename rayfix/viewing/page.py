"""``rayfix view``: the viewer with a site and its fixes in one HTML file that works without a service."""

import base64
import hashlib
import html
import json
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rayfix.errors import ViewError
from rayfix.locate import holds_lines
from rayfix_service.locator import Locator
from rayfix_service.web.assets import INDEX, STATIC, viewer_is_built
from rayfix_service.web.glb import write_glb
from rayfix_service.web.viewer_settings import picture_posterior, viewer_settings
from rayfix_service.wire import InvalidReportError, fix_to_document, parse_report, read_json
from rayfix_service.wire.table import station_summary, table_summary
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table

_PAGES = (".html", ".htm")


@dataclass(frozen=True, kw_only=True)
class View:
    """What a page shows.

    Attributes
    ----------
    num_fixes : int
    num_of_other_table : int
        Fixes of a log that were made with another table.
    """

    num_fixes: int
    num_of_other_table: int = 0


def write_view(
    table_path: Path, output: Path, report_path: Path | None = None, *, recording: Mapping[str, Any] | None = None
) -> View:
    """Write a page that shows a site, and the fixes of a file's reports or of a log.

    Parameters
    ----------
    table_path : pathlib.Path
    output : pathlib.Path
        The page, HTML.
    report_path : pathlib.Path, optional
        A report in the form of ``POST /v1/positions``, or several in ``{"reports": [...]}``.
    recording : mapping, optional
        Fixes of a log, which the page plays; see :func:`rayfix.viewing.recording.read_recording`.

    Returns
    -------
    View

    Raises
    ------
    TableError
        When the table cannot be used.
    ReportError
        When a report cannot be read or used.
    ViewError
        When the viewer is not built, or the page cannot be written.
    """
    if output.suffix.lower() not in _PAGES:
        raise ViewError(f"{output} is not a valid name of a page; end it in {_PAGES[0]}")
    table = open_checked(table_path)
    locator = Locator(table)
    if report_path is not None:
        locator.warm_up()  # otherwise compute_ms of the first fix would include compilation
    events = [] if report_path is None else [_event(locator, document) for document in read_reports(report_path)]
    page = render_view(table_path.stem, table, events, recording)
    try:
        output.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ViewError(f"{output} cannot be written ({error.strerror}); give another file") from error
    played = [] if recording is None else recording["events"]
    others = sum(event["fix"].get("table_id") != table.table_id for event in played)
    return View(num_fixes=len(events) + len(played), num_of_other_table=others)


def read_reports(path: Path) -> list[Mapping[str, Any]]:
    """Read the report of a file, or its ``{"reports": [...]}``.

    Raises
    ------
    ReportError
        When the file has no report; the message names the file.
    """
    try:
        body = path.read_bytes()
        if holds_lines(body):
            raise ReportError(
                "it holds more than one report; locate the log by rayfix locate -o FIXES.jsonl, and show it by --fixes "
                "FIXES.jsonl"
            )
        document = read_json(body)
    except OSError as error:
        raise ReportError(f"{path} cannot be read ({error.strerror}); give a file with a report") from error
    except ReportError as error:
        raise ReportError(f"{path}: {error}", path=error.path) from error
    documents = document["reports"] if isinstance(document, dict) and "reports" in document else [document]
    if not isinstance(documents, list) or not all(isinstance(one, dict) for one in documents):
        raise ReportError(f'{path} is not a report; give {{"measurements": [...]}} or {{"reports": [...]}}')
    return documents


def render_view(
    name: str, table: Table, events: list[dict[str, Any]], recording: Mapping[str, Any] | None = None
) -> str:
    """Return the page as text.

    Parameters
    ----------
    name : str
        Of the table.
    table : Table
    events : list of dict
        Reports with their fixes, in the form of the viewer's events.
    recording : mapping, optional
        Fixes of a log, which the page plays.

    Raises
    ------
    ViewError
        When the viewer is not built.
    """
    data = {
        "table": table_summary(name, table).model_dump(mode="json"),
        "stations": [
            station_summary(station, table.levels(station.id)).model_dump(mode="json")
            for station in table.site.stations
        ],
        "settings": viewer_settings(table, simulation=False).model_dump(mode="json"),
        "scene_base64": base64.b64encode(write_glb(table.scene, table.site.name)).decode(),
        "events": events,
    } | ({} if recording is None else {"recording": recording})
    return inline(STATIC, data, title=f"rayfix · {table.site.name}")


def inline(static: Path, data: Mapping[str, Any], *, title: str) -> str:
    """Combine the built viewer and data into one page, with a Content-Security-Policy for only its script and style."""
    if not viewer_is_built(static):
        raise ViewError(
            "this installation has no viewer, because there was no Node.js 20.19 or later when it was made; install "
            "Node.js and rayfix again, or run 'make viewer' in a checkout; 'rayfix plot' draws a fix without it"
        )
    page = (static / INDEX).read_text(encoding="utf-8")
    script = _only(static, "*.js").replace("</script", "<\\/script").replace("<!--", "<\\!--")
    style = _only(static, "*.css")
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{html.escape(policy)}">'
        f"<title>{html.escape(title)}</title><style>{style}</style>"
    )
    # "<" must not begin a tag within a script element.
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    body = f'<script type="application/json" id="rayfix-data">{text}</script><script type="module">{script}</script>'
    page = re.sub(r"\s*<script\b[^>]*></script>|\s*<link rel=\"stylesheet\"[^>]*>|\s*<title>.*?</title>", "", page)
    page = page.replace("</head>", f"{head}\n  </head>", 1).replace("<head>", f"<head>\n{_licences(static)}", 1)
    return page.replace("</body>", f"{body}\n  </body>", 1)


def _licences(static: Path) -> str:
    """Licences of the bundled code, which must accompany it, as an HTML comment."""
    path = static / "third-party-licences.md"
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    return f"<!--\n{text.replace('--', '- -')}-->"


def _event(locator: Locator, document: Mapping[str, Any]) -> dict[str, Any]:
    try:
        report = parse_report(document)
    except InvalidReportError as error:
        raise ReportError(f"the report cannot be used: {error}", path=error.path) from error
    begin = time.perf_counter()
    fix = locator.locate(report)
    event = {"report": document, "fix": fix_to_document(fix, time.perf_counter() - begin), "source": "file"}
    if fix.position is not None:
        event["posterior"] = picture_posterior(locator, report)
    return event


def _only(static: Path, pattern: str) -> str:
    (path,) = (static / "assets").glob(pattern)
    return path.read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
