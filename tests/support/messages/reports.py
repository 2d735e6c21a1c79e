"""Reports of the hall for the service."""

import copy
from typing import Any

from rayfix_service.http.openapi.examples import REPORT_EXAMPLES

REPORT: dict[str, Any] = REPORT_EXAMPLES["angle_and_time"]["value"]
"""The example: an angle and a range of one station, of a target at (7.0, 4.0, 1.5)."""


def changed(index: int, *without: str, **values: Any) -> dict[str, Any]:
    """Return the example report with one measurement changed."""
    report = copy.deepcopy(REPORT)
    measurement = report["measurements"][index]
    for key in without:
        del measurement[key]
    measurement.update(values)
    return report
