"""What a rival method is: a name, and a position from a report."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.report import Report


class Rival(Protocol):
    """A method that locates a report.

    A rival takes what it knows of a report and leaves the rest: one by time differences leaves the angles. The same
    report gives the same position, whatever came before it; what draws, draws anew from its seed.
    """

    @property
    def name(self) -> str:
        """Name of the method in tables and figures."""

    def locate(self, report: Report) -> NDArray[np.float64] | None:
        """Position of shape (3,), m, in the scene frame, or None where the report is too little for the method.

        Raises
        ------
        ReportError
            When no rival knows what is in the report; see :func:`rayfix_evaluation.paper.reports.sort_for_paper`. A
            known height is all right: methods that cannot use it leave it.
        """
