"""Data for the viewer, in a service or in the file of ``rayfix view``."""

import re
from typing import Any

import numpy as np

from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_service.locator import Locator
from rayfix_service.web.documents import ViewerSettings, posterior_document
from rayfix_tables.table import Table

_SAMPLES = 1500


_MAX_REFLECTIONS = 3
"""Value for tables with a site that does not state it."""


def viewer_settings(table: Table, *, simulation: bool) -> ViewerSettings:
    """Collect the viewer's settings."""
    propagation = table.site.document.get("propagation", {})
    return ViewerSettings(
        simulation=simulation,
        max_reflections=int(propagation.get("max_reflections", _MAX_REFLECTIONS)),
        open_materials=open_materials(table),
    )


def open_materials(table: Table) -> list[str]:
    """Materials of a table's scene that let signals through, as the site file and the scene state them."""
    document = table.site.document
    propagation = document.get("propagation", {})
    if not propagation.get("transmission", False):  # tables of earlier versions know no such key
        return []
    scene = table.scene
    sections = document.get("materials", {})
    found = []
    for number, name in enumerate(scene.materials):
        of = scene.face_materials == number
        stated = scene.face_thickness is not None and bool(np.isfinite(scene.face_thickness[of]).any())
        section = sections.get(name)
        if section is None:
            section = next((value for key, value in sections.items() if _plain(key) == _plain(name)), {})
        of_metal = "permittivity" not in section and "metal" in _plain(section.get("itu", name))
        known = bool({"itu", "permittivity"} & section.keys()) or propagation.get("reflection") == "itu"
        passes = (known or "thickness_m" in section) and ("thickness_m" in section or stated) and not of_metal
        if "transmission_loss_db" in section or passes:
            found.append(name)
    return found


def _plain(name: str) -> str:
    """Name of a material without what exporters add to it."""
    plain = re.sub(r"[-_\s]+", "_", re.sub(r"\.\d+$", "", name.strip().lower()))
    return plain.removeprefix("mat_").removeprefix("itu_")


def picture_posterior(locator: Locator, report: Report, *, stop: Stop = NEVER) -> dict[str, Any]:
    """Build what :class:`PosteriorDocument` describes; equal reports have equal samples."""
    posterior = locator.posterior(report, stop=stop)
    return posterior_document(posterior, posterior.sample(_SAMPLES, np.random.default_rng(0), stop=stop))
