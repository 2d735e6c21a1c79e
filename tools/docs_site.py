"""Hooks of MkDocs (``mkdocs.yml``): pages that are not in ``docs/``, and links that lead out of it.

Pages of ``docs/`` and ``README.md`` link to each other and to files of the repository as GitHub wants it. In the site,
``README.md`` is the start page, other documents of the repository are pages of ``project/``, and any other file that is
linked to is copied below ``files/``. The pages of ``api/`` ask mkdocstrings for the docstrings of the public names.
"""

import ast
import re
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]

PAGES = {
    "README.md": "index.md",
    **{name: f"project/{name}" for name in ("CHANGELOG.md", "CONTRIBUTING.md", "HOW_TO_RELEASE.md", "SECURITY.md")},
}
"""Documents outside ``docs/`` that are pages of the site."""

API = {
    "tables": ("Tables", "Building a table, and reading one.", ("build", "Table")),
    "reports": (
        "Reports",
        "What a report holds. Angles are in radians, lengths in metres.",
        (
            *("Report", "Measurement", "Angle", "Range", "TimeOfArrival", "TimeDifference", "LogRange", "MeasuredPath"),
            "Height",
            *("Frame", "ErrorModel", "GAUSSIAN", "HEAVY_TAILED", "range_from_times", "range_from_round_trip"),
            *("range_from_rssi", "range_from_impulse_response", "RangeEstimate", "LogRangeEstimate"),
            *("paths_from_impulse_response", "PathEstimate"),
        ),
    ),
    "fixes": (
        "Fixes",
        "The fusion and its answer.",
        (
            *("Locator", "FusionSettings", "Fix", "Status", "Candidate", "Outcome", "CredibleRegions", "Posterior"),
            *("Fused", "Stop"),
        ),
    ),
    "tracks": (
        "Tracks",
        "Targets that are followed from report to report.",
        ("Tracker", "TrackingSettings", "MotionModel", "DriftModel", "TrackedPosition", "TrackState", "Estimate"),
    ),
    "client": ("Client", "A service over the network.", ("Client", "AsyncClient", "RetryPolicy")),
    "errors": (
        "Errors",
        "Everything that rayfix raises on purpose.",
        (
            *("RayfixError", "SiteError", "SceneError", "BuildError", "TableError", "NotATableError"),
            *("FormatVersionError", "CorruptTableError", "ReportError", "FixStoppedError", "SettingsError"),
            *("MissingExtraError", "ClientError", "UnreachableError", "AnswerError", "ProblemError", "ProblemField"),
            *("RefusedReportError", "ServiceError", "BrokerError", "HubError", "ViewError"),
        ),
    ),
}
"""Title, first sentence and names of each page of the API; together all of ``rayfix.__all__``."""

_LINK = re.compile(r"(\]\()([^)#\s]+)((?:#[^)\s]*)?\))")
_FENCE = re.compile(r"^( *)(`{3,}).*?^\1\2 *$", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in ``docs/``, and the files that pages link to."""
    check_names()
    for source, target in PAGES.items():
        files.append(File.generated(config, target, content=(ROOT / source).read_text(encoding="utf-8")))
    for name, (title, lead, names) in API.items():
        files.append(File.generated(config, f"api/{name}.md", content=api_page(title, lead, names)))
    linked = {target for page in list(files.documentation_pages()) for target in outside(page)}
    for target in sorted(linked):
        files.append(File.generated(config, f"files/{target}", abs_src_path=str(ROOT / target)))
    return files


def on_page_content(html: str, page: Page, **_: Any) -> None:
    """Refuse a page of the API on which a name has no entry, since mkdocstrings leaves out what has no docstring."""
    name = PurePosixPath(page.file.src_uri)
    if str(name.parent) == "api":
        missing = [each for each in API[name.stem][2] if f'id="rayfix.{each}"' not in html]
        if missing:
            raise PluginError(f"{name} has no entry of {', '.join(missing)}: write docstrings for them")


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Turn links of the repository into those of the site, and leave out what only tests read."""
    source = repository_path(page.file.src_uri)
    return without_marks(with_links_of_site(markdown, source, page.file.src_uri))


def check_names() -> None:
    """Hold the pages of the API to ``rayfix.__all__``, which is read and not imported."""
    tree = ast.parse((ROOT / "rayfix/__init__.py").read_text(encoding="utf-8"))
    (public,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    )
    shown = [name for _, _, names in API.values() for name in names]
    wrong = sorted({*public} - {"__version__"} ^ {*shown})
    if wrong or len(shown) != len(set(shown)):
        raise PluginError(f"API of tools/docs_site.py must name each of rayfix.__all__ once: {', '.join(wrong)}")


def api_page(title: str, lead: str, names: tuple[str, ...]) -> str:
    """Return Markdown that asks mkdocstrings for the docstrings of public names."""
    return f"# {title}\n\n{lead}\n\n" + "".join(f"::: rayfix.{name}\n\n" for name in names)


def repository_path(page: str) -> str:
    """Path in the repository of a page of the site."""
    return next((source for source, target in PAGES.items() if target == page), f"docs/{page}")


def site_path(source: str) -> str:
    """Path in the site of a file of the repository."""
    if source in PAGES:
        return PAGES[source]
    return source.removeprefix("docs/") if source.startswith("docs/") else f"files/{source}"


def targets(markdown: str, source: str) -> list[str]:
    """Files of the repository that a page of it links to."""
    folder = PurePosixPath(source).parent
    links = _LINK.findall(_FENCE.sub("", markdown))
    return [normpath(str(folder / link)) for _, link, _ in links if ":" not in link]


def outside(page: File) -> set[str]:
    """Files that a page links to that are not in the site yet; MkDocs finds missing ones."""
    if page.src_uri.startswith("api/"):
        return set()
    found = targets(page.content_string, repository_path(page.src_uri))
    return {
        target
        for target in found
        if target not in PAGES and not target.startswith(("docs/", "../")) and (ROOT / target).is_file()
    }


def with_links_of_site(markdown: str, source: str, page: str) -> str:
    """Return a page of the repository with its links as the site has them; blocks of code stay."""
    folder, site_folder = PurePosixPath(source).parent, str(PurePosixPath(page).parent)

    def replaced(match: re.Match[str]) -> str:
        before, link, after = match.groups()
        if ":" in link:
            return match[0]
        return before + relpath(site_path(normpath(str(folder / link))), site_folder) + after

    parts, end = [], 0
    for fence in _FENCE.finditer(markdown):
        parts += [_LINK.sub(replaced, markdown[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, _LINK.sub(replaced, markdown[end:])])


def without_marks(markdown: str) -> str:
    """Return a page without what ``tests/docs`` reads: comments before code blocks, and words after their language."""
    markdown = re.sub(r"^<!-- not run: .*?-->\n", "", markdown, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^(```\w+) .*$", r"\1", markdown, flags=re.MULTILINE)
