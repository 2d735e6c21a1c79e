"""Fit settings that the fit study compares."""

from dataclasses import dataclass

from rayfix_offline.fit.settings import ExpectationMaximisation, TubeFit
from rayfix_offline.rays.settings import RaySettings


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One way to fit a cell.

    Attributes
    ----------
    family : str
        What is varied.
    value : float
        Its value.
    cells : {"all", "some", "few"}
        Which cells are fitted: all of them, those of ``--some`` or those of ``--few``.
    """

    name: str
    family: str
    fit: TubeFit | ExpectationMaximisation
    value: float = 0.0
    slice_ratio: float = RaySettings.slice_ratio
    cells: str = "some"


SWEEPS: dict[str, tuple[float, ...]] = {
    "slice_ratio": (1.15, 1.2, 1.35, 1.5, 2.0),
    "max_divergence": (1e-3, 3e-3, 1e-2, 3e-2),
    "max_components": (16, 32, 48, 96),
    "dropped_mass": (1e-3, 1e-4, 1e-5),
}

DEFAULT = Setting(name="tubes, default", family="default", fit=TubeFit(), cells="all")

CAREFUL = TubeFit(dropped_mass=1e-5)

CANDIDATES = (
    Setting(name="tubes, dropped_mass 1e-05", family="candidate", fit=CAREFUL, cells="all"),
    Setting(
        name="tubes, dropped_mass 1e-05, slice_ratio 1.15",
        family="candidate",
        fit=CAREFUL,
        slice_ratio=1.15,
        cells="all",
    ),
)


def default_of(family: str) -> float:
    """Value of a swept setting in the default fit."""
    return RaySettings.slice_ratio if family == "slice_ratio" else float(getattr(DEFAULT.fit, family))


def swept(family: str, value: float) -> Setting:
    """Return the default with one setting changed."""
    name = f"{family} {value:g}"
    if family == "slice_ratio":
        return Setting(name=name, family=family, value=value, fit=TubeFit(), slice_ratio=value)
    changed = {family: int(value) if family == "max_components" else value}
    return Setting(name=name, family=family, value=value, fit=TubeFit(**changed))


SETTINGS: tuple[Setting, ...] = (
    DEFAULT,
    *(
        swept(family, value)
        for family, values in SWEEPS.items()
        for value in values
        if value != default_of(family)  # the default itself is measured once
    ),
    *CANDIDATES,
    Setting(name="em, K = 16", family="em", fit=ExpectationMaximisation(num_components=(16,)), cells="all"),
    Setting(name="em, BIC", family="em", fit=ExpectationMaximisation(), cells="few"),
    Setting(name="em, K = 32", family="em", fit=ExpectationMaximisation(num_components=(32,)), cells="few"),
)
