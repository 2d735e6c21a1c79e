"""The studies: their cases, methods and numbers of drops."""

from collections.abc import Sequence
from dataclasses import dataclass

from rayfix_evaluation.drops.simulate import Rule, Timing
from rayfix_evaluation.studies.cases import Case, World
from rayfix_evaluation.studies.methods import METHODS

__all__ = ["FULL", "QUICK", "Effort", "Point", "Study", "methods_of", "studies"]

ANGLES_DEG = (0.25, 0.5, 0.75, 1.0)
RANGES = (0.2, 0.3, 0.5, 0.7, 1.0)
"""Standard deviations of propagation times in the paper's figures, m; those of its RPT figure are not published."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Size of an evaluation.

    Attributes
    ----------
    drops : int
        Drops for the paper's figures and the comparison of methods.
    stress_drops : int
        Drops of each point of a curve.
    array_drops : int
        Drops of the angle errors of antenna arrays.
    coarse : bool
        Whether tables of other path priors have only wide windows.
    map_spacing : float, m
        Spacing of the map of fingerprints and of planning maps.
    """

    name: str
    drops: int
    stress_drops: int
    array_drops: int
    coarse: bool
    map_spacing: float


QUICK = Effort(name="quick", drops=24, stress_drops=24, array_drops=8, coarse=True, map_spacing=1.0)
FULL = Effort(name="full", drops=300, stress_drops=150, array_drops=60, coarse=False, map_spacing=0.5)


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of a study: its name, its coordinate on the axis (if there is one), its case, and its methods."""

    label: str
    x: float | None = None
    case: Case
    methods: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Study:
    """Points of one figure.

    Attributes
    ----------
    key : str
        Name in files.
    title : str
    axis : str
        Label of ``Point.x`` with its unit; empty if the points have no axis.
    drops : int
    """

    key: str
    title: str
    axis: str = ""
    drops: int
    points: tuple[Point, ...]


def methods_of(case: Case, keys: Sequence[str]) -> tuple[str, ...]:
    """Methods that can use the measurements of a case."""
    return tuple(key for key in keys if case.timing in METHODS[key].timings)


def studies(effort: Effort, *, station_ids: Sequence[str], reflections: int) -> tuple[Study, ...]:
    """Return all studies of a site.

    Parameters
    ----------
    station_ids : sequence of str
    reflections : int
        Largest number of reflections of paths in the table.
    """
    return (*_paper_figures(effort), _side_by_side(effort), *_stress(effort, station_ids, reflections))


def _paper_figures(effort: Effort) -> tuple[Study, ...]:
    both = ("rayfix", "paper")

    def point(label: str, case: Case, x: float) -> Point:
        return Point(label=label, x=x, case=case, methods=methods_of(case, both))

    timings: tuple[Timing, ...] = ("none", "pt")
    return (
        Study(
            key="cdf-aoa",
            title="Error against the noise of the angles, with and without propagation times",
            axis="standard deviation of the angles [deg]",
            drops=effort.drops,
            points=tuple(
                point(f"{a:g} deg" + (" + PT 0.5 m" if t == "pt" else ""), Case(angle_deg=a, timing=t), a)
                for t in timings
                for a in ANGLES_DEG
            ),
        ),
        Study(
            key="cdf-pt",
            title="Error against the noise of the propagation times",
            axis="standard deviation of the propagation times [m]",
            drops=effort.drops,
            points=tuple(point(f"PT {r:g} m", Case(range_stdev=r), r) for r in RANGES),
        ),
        Study(
            key="cdf-rpt",
            title="Error against the noise of relative propagation times",
            axis="standard deviation of the relative propagation times [m]",
            drops=effort.drops,
            points=(
                *(point(f"RPT {r:g} m", Case(timing="tdoa", range_stdev=r), r) for r in RANGES),
                point("RPT 0.5 m, 0.25 deg", Case(angle_deg=0.25, timing="tdoa"), 0.5),
            ),
        ),
    )


def _side_by_side(effort: Effort) -> Study:
    cases = {
        "AoA 1 deg + PT 0.5 m": Case(),
        "AoA 1 deg": Case(timing="none"),
        "AoA 1 deg + RPT 0.5 m": Case(timing="tdoa"),
        "AoA 0.25 deg + PT 0.5 m": Case(angle_deg=0.25),
        "AoA 0.25 deg": Case(angle_deg=0.25, timing="none"),
    }
    return Study(
        key="methods",
        title="Methods side by side",
        drops=effort.drops,
        points=tuple(
            Point(
                label=label,
                case=case,
                methods=methods_of(case, [key for key, method in METHODS.items() if method.compared]),
            )
            for label, case in cases.items()
        ),
    )


_STRESSED: tuple[str, ...] = ("rayfix", "paper-table", "los-angles", "los-robust")
"""Methods of the curves: the fast variant of the paper's method, and classical systems, plain and robust."""


def _stress(effort: Effort, station_ids: Sequence[str], reflections: int) -> tuple[Study, ...]:
    def study(key: str, title: str, axis: str, cases: Sequence[tuple[str, float | None, Case]]) -> Study:
        return Study(
            key=f"stress-{key}",
            title=title,
            axis=axis,
            drops=effort.stress_drops,
            points=tuple(
                Point(label=label, x=x, case=case, methods=methods_of(case, _STRESSED)) for label, x, case in cases
            ),
        )

    rules: tuple[Rule, ...] = ("strongest", "first", "random")
    timings: tuple[Timing, ...] = ("pt", "none")
    heard = range(1, len(station_ids) + 1)
    return (
        study(
            "heard",
            "Number of audible stations",
            "stations in the report (at most)",
            [(f"{n}", n, Case(heard=n)) for n in heard],
        ),
        study(
            "blocked",
            "Without line of sight",
            "fraction of direct paths that are blocked",
            [(f"{share:.0%}", share, Case(blocked=share)) for share in (0.0, 0.25, 0.5, 0.75, 1.0)],
        ),
        study(
            "rule",
            "Which path a station reports",
            "",
            [
                (f"{rule}{', no times' if timing == 'none' else ''}", None, Case(rule=rule, timing=timing))
                for timing in timings
                for rule in rules
            ],
        ),
        study(
            "objects",
            "Displaced objects",
            "displacement of objects [cm]",
            [(f"{cm} cm", cm, Case(world=World(objects=cm / 100))) for cm in (0, 2, 5, 10)],
        ),
        study(
            "walls",
            "Displaced outer walls",
            "displacement of walls [cm]",
            [(f"{cm} cm", cm, Case(world=World(walls=cm / 100))) for cm in (0, 1, 2, 5)],
        ),
        study(
            "told",
            "Wrong standard deviations",
            "stated over true standard deviation",
            [(f"{factor:g}", factor, Case(told=factor)) for factor in (0.25, 0.5, 1.0, 2.0, 4.0)],
        ),
        study(
            "bias",
            "Biased angles",
            "bias of azimuth and zenith [deg]",
            [(f"{bias:g} deg", bias, Case(bias_deg=bias)) for bias in (0.0, 0.25, 0.5, 1.0, 2.0)],
        ),
        study(
            "missing",
            "A station out of service",
            "",
            [("none", None, Case()), *((name, None, Case(without=name)) for name in station_ids[:8])],
        ),
        study(
            "outliers",
            "Outlying angles",
            "stations with a random angle",
            [(f"{n}", n, Case(random_angles=n)) for n in range(len(station_ids[:5]))],
        ),
        study(
            "late",
            "Times that are 10 m too long",
            "stations with such a time",
            [(f"{n}", n, Case(late_times=n)) for n in range(len(station_ids[:5]))],
        ),
        _reflections(effort, reflections),
    )


def _reflections(effort: Effort, reflections: int) -> Study:
    """Compare tables of fewer reflections in the same world, and the site's table in a world of one reflection more."""
    fewer = [n for n in (1, 2, 3) if n <= reflections]
    points = [
        Point(label=f"table {reflections}, world {reflections}", x=0, case=Case(), methods=("rayfix",)),
        *(
            Point(
                label=f"table {reflections - n}, world {reflections}",
                x=n,
                case=Case(),
                methods=(f"rayfix-fewer-{n}",),
            )
            for n in fewer
        ),
        Point(
            label=f"table {reflections}, world {reflections + 1}",
            x=1,
            case=Case(world=World(more_reflections=1)),
            methods=("rayfix",),
        ),
    ]
    return Study(
        key="stress-reflections",
        title="More reflections in the world than in the table",
        axis="reflections in the world beyond those in the table",
        drops=effort.stress_drops,
        points=tuple(points),
    )
