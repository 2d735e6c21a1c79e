"""The method: all numbers of the software that decide the content of a table.

They belong to the identity of each part of a table (:func:`rayfix_offline.job.plan.plan_build`): a part that was built
with another number is built again.
"""

import dataclasses
from dataclasses import dataclass, field, replace
from typing import Any

from rayfix_offline.fit.settings import BalanceSettings, CoarseFit, ExpectationMaximisation, TubeFit
from rayfix_offline.job.changes import SMALLEST, ComparisonSettings
from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.rays.voxelwalk import GAUSS, RAY_RANGES
from rayfix_offline.scene.materials import ITU_MATERIALS, VACUUM_PERMITTIVITY, ItuParameters, ReflectionSettings
from rayfix_offline.site import SiteFile
from rayfix_offline.twin.settings import TwinSettings
from rayfix_tables.gaussians.normal_points import SQUARES
from rayfix_tables.gaussians.tree_reduction import SMALLEST_PIVOT


@dataclass(frozen=True, kw_only=True)
class FixedNumbers:
    """Constants of compiled kernels and of standards: part of the identity, but not adjustable."""

    gauss: tuple[tuple[float, float], ...] = field(default=GAUSS, init=False)
    ray_ranges: int = field(default=RAY_RANGES, init=False)
    smallest_pivot: float = field(default=SMALLEST_PIVOT, init=False)
    smallest_change: float = field(default=SMALLEST, init=False)
    normal_squares: tuple[float, ...] = field(default=SQUARES, init=False)
    vacuum_permittivity: float = field(default=VACUUM_PERMITTIVITY, init=False)
    itu_materials: dict[str, tuple[ItuParameters, ...]] = field(default_factory=lambda: ITU_MATERIALS, init=False)


@dataclass(frozen=True, kw_only=True)
class Method:
    """Settings of all steps of a build."""

    twin: TwinSettings = field(default_factory=TwinSettings)
    rays: RaySettings = field(default_factory=RaySettings)
    reflection: ReflectionSettings = field(default_factory=ReflectionSettings)
    tubes: TubeFit = field(default_factory=TubeFit)
    em: ExpectationMaximisation = field(default_factory=ExpectationMaximisation)
    wide: CoarseFit = field(default_factory=CoarseFit)
    balance: BalanceSettings = field(default_factory=BalanceSettings)
    comparison: ComparisonSettings = field(default_factory=ComparisonSettings)
    fixed: FixedNumbers = field(default_factory=FixedNumbers)

    def fit(self, site: SiteFile) -> TubeFit | ExpectationMaximisation:
        """Return the settings of the fit that a site selects."""
        return replace(self.em, seed=site.table.seed) if site.table.fit == "em" else self.tubes

    def identity(self) -> dict[str, Any]:
        """Return all numbers as JSON-compatible data."""
        return dataclasses.asdict(self)
