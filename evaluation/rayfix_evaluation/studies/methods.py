"""The methods that are compared, in one registry.

A method is made once per process from its :class:`Tools` and then locates reports. If the position is undetermined or a
measurement is not supported, it returns no position.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.baselines.fingerprints import Fingerprinting, RadioMap
from rayfix_evaluation.baselines.line_of_sight import Kind, LineOfSight
from rayfix_evaluation.baselines.planar import PlanarPredecessor
from rayfix_evaluation.baselines.reverse_rays import ReverseRays
from rayfix_evaluation.drops.calibration import ellipsoid_holds
from rayfix_evaluation.drops.simulate import Timing
from rayfix_evaluation.paper.locate import PaperLocator
from rayfix_evaluation.studies.plain_mixtures import PlainTableLocator
from rayfix_evaluation.studies.summary import COVERAGE
from rayfix_service.fusion.measurements.report import Height, Report
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

__all__ = ["METHODS", "Answer", "Method", "Question", "Tools"]

_STRAIGHT: tuple[tuple[Kind, str, frozenset[Timing]], ...] = (
    ("angles", "angles", frozenset(["none", "pt", "toa", "tdoa"])),
    ("ranges", "ranges", frozenset(["pt"])),
    ("differences", "time differences", frozenset(["toa", "tdoa"])),
)

_ANY: frozenset[Timing] = frozenset(["none", "pt", "toa", "tdoa"])


@dataclass(frozen=True, kw_only=True)
class Question:
    """A report to locate.

    Attributes
    ----------
    truth : ndarray of shape (3,), m
        True position, for methods that are given a part of it, such as the height.
    """

    report: Report
    truth: NDArray[np.float64]
    rng: np.random.Generator


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Answer of a method.

    Attributes
    ----------
    position : ndarray of shape (3,), m, or None
    covered : tuple of bool or None
        Whether the ellipsoids of ``COVERAGE`` contain the truth; None without a stated uncertainty.
    """

    position: NDArray[np.float64] | None
    covered: tuple[bool, ...] | None = None


Answering = Callable[[Question], Answer]


@dataclass(frozen=True, kw_only=True)
class Tools:
    """Data from which methods are made.

    Attributes
    ----------
    tables : mapping of str to Path
        Tables by variant; ``"site"`` is that of the site itself.
    radio_map : RadioMap or None
        Map of the fingerprints. Making it takes longer than all answers; it is made once for all processes.
    """

    tables: Mapping[str, Path]
    radio_map: RadioMap | None = None

    def table(self, variant: str) -> Table:
        """Open a variant of the table, in its own frame."""
        return Table.open(self.tables[variant]).in_table_frame


@dataclass(frozen=True, kw_only=True)
class Method:
    """One method.

    Attributes
    ----------
    key, label : str
        Name in files, and for display.
    note : str
        One sentence on the method and its inputs.
    variant : str
        Variant of the table that it needs.
    timings : frozenset of str
        Times that it can use in addition to angles.
    calibrated : bool
        Whether it states an uncertainty that can be checked.
    weight : float
        Approximate time relative to rayfix, for the progress bar.
    needs_map : bool
        Whether it needs the map of fingerprints.
    compared : bool
        Whether it is in the comparison of methods, or only in a single study.
    make : callable
        Makes the method from tools.
    """

    key: str
    label: str
    note: str
    variant: str = "site"
    timings: frozenset[Timing] = _ANY
    calibrated: bool = False
    weight: float = 1.0
    needs_map: bool = False
    compared: bool = True
    make: Callable[[Tools], Answering]


def _rayfix(variant: str) -> Callable[[Tools], Answering]:
    def make(tools: Tools) -> Answering:
        locator = Locator(tools.table(variant))
        locator.warm_up()

        def answer(question: Question) -> Answer:
            fix = locator.locate(question.report)
            if fix.position is None:
                return Answer(position=None)
            return Answer(
                position=fix.position,
                covered=tuple(ellipsoid_holds(fix, p, question.truth) for p in COVERAGE),
            )

        return answer

    return make


def _from_reports(locate: Callable[[Report], NDArray[np.float64] | None]) -> Answering:
    """Answer by a method that needs only the report."""
    return lambda question: Answer(position=locate(question.report))


def _paper(tools: Tools) -> Answering:
    locator = PaperLocator.of_table(tools.table("site"))
    return lambda question: Answer(position=locator.locate(question.report, question.rng))


def _paper_table(tools: Tools) -> Answering:
    return _from_reports(PlainTableLocator(table=tools.table("paper")).locate)


def _planar(tools: Tools) -> Answering:
    locator = PlanarPredecessor.of_table(tools.table("site"))

    def answer(question: Question) -> Answer:
        height = Height(z=float(question.truth[2]), stdev=0.01)
        return Answer(position=locator.locate(replace(question.report, height=height)))

    return answer


def _reverse_rays(tools: Tools) -> Answering:
    return _from_reports(ReverseRays.of_table(tools.table("site")).locate)


def _line_of_sight(*kinds: Kind, robust: bool = False) -> Callable[[Tools], Answering]:
    def make(tools: Tools) -> Answering:
        table = tools.table("site")
        vertices = np.asarray(table.scene.vertices, np.float64)
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        return _from_reports(LineOfSight(site=table.site, bounds=bounds, kinds=kinds, robust=robust).locate)

    return make


def _fingerprints(tools: Tools) -> Answering:
    assert tools.radio_map is not None
    return _from_reports(Fingerprinting(site=tools.table("site").site, radio_map=tools.radio_map).locate)


_OURS = (
    Method(
        key="rayfix",
        label="rayfix",
        note="The table of the site file: s^2 and the path-selection prior, closed-form conditioning on angles and "
        "times, outliers, free space.",
        calibrated=True,
        make=_rayfix("site"),
    ),
    Method(
        key="rayfix-uniform",
        label="rayfix, uniform prior",
        note="The same with a table without the path prior: all paths from a position are equally likely.",
        variant="uniform",
        calibrated=True,
        make=_rayfix("uniform"),
    ),
    Method(
        key="rayfix-paper",
        label="rayfix, paper's prior",
        note="The same with a table that weights all points along a ray equally, as the paper does.",
        variant="paper",
        calibrated=True,
        make=_rayfix("paper"),
    ),
    Method(
        key="paper",
        label="paper's method, online",
        note="Rays launched for each report, Algorithm 1 or 2, EM, product, arg max.",
        weight=50.0,
        make=_paper,
    ),
    Method(
        key="paper-table",
        label="paper's method, plain table",
        note="Mixtures of the nearest cells without correction for the angle within a cell, product, arg max.",
        variant="paper",
        timings=frozenset(["none", "pt"]),
        weight=10.0,
        make=_paper_table,
    ),
)

_RIVALS = (
    Method(
        key="planar",
        label="2D predecessor, true height",
        note="Rays of the angles are intersected with the plane of the transmitter's exactly known height; 2D "
        "mixtures, product. Times are not used.",
        weight=10.0,
        make=_planar,
    ),
    Method(
        key="reverse-rays",
        label="noise-free reverse rays",
        note="One reflected ray for each measured angle, and the point nearest to all. Times are not used.",
        weight=3.0,
        make=_reverse_rays,
    ),
    *(
        Method(
            key=f"los-{kind}",
            label=f"least squares on {text}",
            note=f"Weighted least squares on {text} as if every path were the line of sight.",
            timings=timings,
            weight=5.0,
            make=_line_of_sight(kind),
        )
        for kind, text, timings in _STRAIGHT
    ),
    Method(
        key="los-robust",
        label="robust least squares on all",
        note="Angles and times together as if every path were the line of sight, with Cauchy's loss: what is many "
        "deviations off counts little.",
        weight=8.0,
        make=_line_of_sight(*(kind for kind, _, _ in _STRAIGHT), robust=True),
    ),
    Method(
        key="fingerprints",
        label="k-NN fingerprints",
        note="Weighted mean of the points of a simulated map whose strongest paths are most similar to the report.",
        needs_map=True,
        make=_fingerprints,
    ),
)

_FEWER = tuple(
    Method(
        key=f"rayfix-fewer-{n}",
        label=f"rayfix, {n} fewer reflections",
        note=f"With a table of {n} reflections fewer than in the site file.",
        variant=f"fewer-{n}",
        calibrated=True,
        compared=False,
        make=_rayfix(f"fewer-{n}"),
    )
    for n in (1, 2, 3)
)

METHODS: dict[str, Method] = {method.key: method for method in (*_OURS, *_RIVALS, *_FEWER)}
"""All methods by key."""
