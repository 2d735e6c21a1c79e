"""Data for the viewer, in a service or in the file of ``rayfix view``."""

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
        simulation=simulation, max_reflections=int(propagation.get("max_reflections", _MAX_REFLECTIONS))
    )


def picture_posterior(locator: Locator, report: Report, *, stop: Stop = NEVER) -> dict[str, Any]:
    """Build what :class:`PosteriorDocument` describes; equal reports have equal samples."""
    posterior = locator.posterior(report, stop=stop)
    return posterior_document(posterior, posterior.sample(_SAMPLES, np.random.default_rng(0), stop=stop))
