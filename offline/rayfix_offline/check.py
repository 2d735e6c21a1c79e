"""``rayfix check``: all problems of a site and its scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rayfix_offline.rays.lost_rays import LOST_RAYS_WARNING, Escapes, find_escapes
from rayfix_offline.site import read_site
from rayfix_offline.twin.findings import Finding
from rayfix_offline.twin.twin import Twin, prepare_twin
from rayfix_tables.level import WIDE_RATIO, WINDOW_RATIO

NOTABLE_FRACTION = 0.05
"""The position where most rays leave is named if at least this fraction of the lost rays leave there."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Result of a check.

    Attributes
    ----------
    escapes : tuple of Escapes
        One for each station at a valid position.
    """

    site_path: Path
    twin: Twin
    findings: tuple[Finding, ...]
    escapes: tuple[Escapes, ...]

    @property
    def num_errors(self) -> int:
        """Number of findings that stop a build."""
        return sum(finding.severity == "error" for finding in self.findings)

    @property
    def windows_deg(self) -> tuple[float, ...]:
        """Windows of angles, finest first."""
        return tuple(self.twin.site.table.windows_deg)

    @property
    def best_up_to_deg(self) -> float:
        """Deviation of angles up to which one cell of the finest window answers."""
        return self.windows_deg[0] / WINDOW_RATIO

    @property
    def integrated_from_deg(self) -> float:
        """Deviation of angles from which on they are integrated on the path map, where no clock is unknown."""
        return self.windows_deg[0] * WIDE_RATIO

    @property
    def quick_up_to_deg(self) -> float:
        """Deviation of angles beside times of unknown clocks up to which one cell answers."""
        return self.windows_deg[-1] / WINDOW_RATIO

    def document(self) -> dict[str, Any]:
        """Return the check as JSON-compatible data."""
        twin = self.twin
        return {
            "site": str(self.site_path),
            "scene": {
                "size_m": [round(float(length), 6) for length in twin.scene.bounds[1] - twin.scene.bounds[0]],
                "triangles": len(twin.scene.faces),
                "planes": len(twin.planes),
                "surfaces": twin.planes.num_surfaces,
                "closed": twin.closed,
                "free_space_m3": round(twin.free_space.volume, 3),
                "materials": list(twin.scene.materials),
            },
            "stations": [
                {
                    "id": escapes.station_id,
                    "lost_ray_share": escapes.share,
                    "most_to": escapes.side,
                    "most_at_m": list(escapes.place) if escapes.place else None,
                }
                for escapes in self.escapes
            ],
            "windows": {
                "windows_deg": list(self.windows_deg),
                "best_up_to_deg": round(self.best_up_to_deg, 6),
                "integrated_from_deg": round(self.integrated_from_deg, 6),
                "unknown_clocks_quick_up_to_deg": round(self.quick_up_to_deg, 6),
            },
            "findings": [
                {
                    "severity": finding.severity,
                    "kind": finding.kind,
                    "problem": finding.problem,
                    "remedy": finding.remedy,
                    "station_id": finding.station_id,
                }
                for finding in self.findings
            ],
        }


def check_site(site_path: Path) -> Check:
    """Check a site and its scene.

    Raises
    ------
    SiteError, SceneError
        When the site file or the scene cannot be read at all.
    """
    site = read_site(site_path)
    twin = prepare_twin(site, site_path.parent)
    misplaced = {finding.station_id for finding in twin.findings}
    escapes = tuple(
        find_escapes(station, twin, max_reflections=site.propagation.max_reflections).moved(twin.origin)
        for station in twin.site.stations
        if station.id not in misplaced
    )
    holes = (_hole(found, twin) for found in escapes if found.share > LOST_RAYS_WARNING)
    return Check(site_path=site_path, twin=twin, findings=(*twin.findings, *holes), escapes=escapes)


def _hole(escapes: Escapes, twin: Twin) -> Finding:
    where = f"{escapes.side_share:.0%} of them towards {escapes.side}"
    if escapes.place is not None and escapes.place_share > NOTABLE_FRACTION:
        at = ", ".join(f"{v:.1f}" for v in escapes.place)
        where += f", {escapes.place_share:.0%} near ({at}) m"
    return Finding(
        severity="warning",
        kind="hole",
        problem=f"{escapes.share:.1%} of the rays of station '{escapes.station_id}' leave the scene, {where}",
        remedy="close the hole there" if twin.closed else "close it there, unless the site is open to that side",
        station_id=escapes.station_id,
    )
