"""Additional tables of an evaluation: with other path priors and with fewer reflections."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from rayfix_evaluation.studies.store import write_text
from rayfix_offline.build import build_table
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import TableError

__all__ = ["SITE", "build_variants", "open_site_table"]

SITE = "site"
"""The table of the site file itself."""

_COARSE = 2.0
"""Factor by which the finest window of coarse tables is wider."""

Progress = Callable[[str, int, int], None]


def open_site_table(site_path: Path, table_path: Path | None, folder: Path, *, jobs: int, progress: Progress) -> Path:
    """Return the path of the site's table: the given one, if it is of this site, or one that is built in a folder.

    Raises
    ------
    SiteError, SceneError, BuildError
        When the site cannot be used.
    TableError
        When the table cannot be used or is of another site.
    """
    site = read_site(site_path)
    if table_path is None:
        path = folder / f"{SITE}.h5"
        build_table(site_path, path, jobs=jobs, progress=progress)
        return path
    table = open_checked(table_path)
    wanted, found = site.info().document, table.site.document
    different = _difference(wanted, found)
    if different is not None:
        raise TableError(
            f"{table_path} was not built from {site_path}: {different}; build it again, or leave out --table"
        )
    if prepare_twin(site, site_path.parent).scene.sha256 != table.scene.sha256:
        raise TableError(
            f"{table_path} was built from another version of {site.site.scene or 'its room'}; build it again, or leave "
            "out --table"
        )
    return table_path


def build_variants(
    site_path: Path, folder: Path, names: Sequence[str], *, coarse: bool, jobs: int, progress: Progress
) -> dict[str, Path]:
    """Build variants of a site's table in a folder; existing ones are kept.

    Parameters
    ----------
    names : sequence of str
        Path priors, and ``"fewer-1"`` and so on for fewer reflections. These have a single window.
    coarse : bool
        Whether the finest window is twice as wide as the site's.

    Raises
    ------
    RayfixError
        When a table cannot be built or written.
    """
    site = read_site(site_path)
    found = {}
    for name in names:
        text = tomli_w.dumps(_variant(site, site_path, name, coarse))
        changed = folder / f"{name}.toml"
        write_text(changed, text)
        found[name] = changed.with_suffix(".h5")
        build_table(changed, found[name], jobs=jobs, progress=progress)
    return found


def _variant(site: SiteFile, site_path: Path, name: str, coarse: bool) -> dict[str, Any]:
    document = site.model_dump(mode="json", exclude_none=True)  # TOML has no null
    if site.site.scene is not None:
        document["site"]["scene"] = str((site_path.parent / site.site.scene).resolve())
    finest, *wider = site.table.windows_deg
    if coarse:
        finest = min(_COARSE * finest, 30.0)
        wider = [window for window in wider if window >= _COARSE * finest]
    if name.startswith("fewer-"):
        document["propagation"]["max_reflections"] -= int(name.removeprefix("fewer-"))
        wider = []
    else:
        document["propagation"]["path_prior"] = name
    document["table"]["windows_deg"] = [finest, *wider]
    return document


def _difference(wanted: Any, found: Any, where: str = "") -> str | None:
    """Describe the first key that differs; None if there is none."""
    if isinstance(wanted, dict) and isinstance(found, dict):
        for key in wanted | found:
            different = _difference(wanted.get(key), found.get(key), f"{where}.{key}".lstrip("."))
            if different is not None:
                return different
        return None
    if isinstance(wanted, list) and isinstance(found, list) and len(wanted) == len(found):
        for n, pair in enumerate(zip(wanted, found, strict=True)):
            different = _difference(*pair, f"{where}[{n}]")
            if different is not None:
                return different
        return None
    return (
        None if wanted == found else f"{where} is {json.dumps(wanted)} in the site and {json.dumps(found)} in the table"
    )
