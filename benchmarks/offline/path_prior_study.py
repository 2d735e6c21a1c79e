"""Necessary resolution of the path prior's voxel map: rays and voxels compared with the image method.

At positions on a station's rays, drawn uniformly from the volume that the rays sweep, the image method gives the exact
sum of gain^beta over all paths. Maps of several ray spacings and voxel sizes are compared by the error of the logarithm
of that sum, and by the fraction of the rays' weight s^2 pi that they misplace. Draws docs/path-prior.svg.
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from benchmarks.common.warehouse import write_warehouse
from rayfix.example.files import write_example
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_offline.rays.pathprior import PathPrior, fill_path_prior, wall_factors
from rayfix_offline.rays.trace import launch_rays
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import Twin, prepare_twin

SPACINGS_DEG = (0.21, 0.42, 0.83, 1.67)
"""Spacings of the rays that fill the map."""

REFINEMENTS = (1, 2, 4, 8)
"""Edges of the map's voxels, in voxels of the free space."""


@dataclass(frozen=True)
class Places:
    """Places on rays.

    Attributes
    ----------
    position : ndarray of shape (n, 3), m
    own : ndarray of shape (n,)
        gain^beta of the path along the ray.
    total : ndarray of shape (n,)
        Sum of gain^beta over all paths, by the image method.
    """

    position: NDArray[np.float64]
    own: NDArray[np.float64]
    total: NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/path-prior.svg"))
    options = parser.parse_args()
    results = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sites = {"hall": write_example(folder / "hall"), "warehouse": write_warehouse(folder / "warehouse")}
        for site_name, path in sites.items():
            if path is None:
                print(f"{site_name}: its scene is not here")
                continue
            site = read_site(path)
            results[site_name] = study(site_name, site, prepare_twin(site, path.parent), options.places, options.seed)
    plot(results, options.output)


def draw_places(site: SiteFile, twin: Twin, count: int, rng: np.random.Generator) -> Places:
    """Draw places on rays, in proportion to s^2, and find all paths to them."""
    rays, segments = launch_rays(
        site.stations[0], site, twin, np.deg2rad(1.0), np.random.default_rng(int(rng.integers(2**31)))
    )
    exponent = site.propagation.path_prior_exponent
    solver = ForwardSolver.from_mesh(
        twin.scene.vertices,
        twin.scene.faces,
        max_reflections=site.propagation.max_reflections,
        max_path_length=site.propagation.max_path_length_m,
        reflection_loss_db=site.propagation.reflection_loss_db,
    )
    station = solver.station(np.array(site.stations[0].position_m))
    volume = segments.end**3 - segments.start**3
    chosen = rng.choice(len(volume), count, p=volume / volume.sum())
    ray, start, end = segments.ray[chosen], segments.start[chosen], segments.end[chosen]
    length = np.cbrt(start**3 + rng.random(count) * (end**3 - start**3))
    sequence = segments.sequence[chosen]
    heading = np.einsum("nij,nj->ni", segments.sequences.mirrors[sequence], rays.directions[ray])
    position = segments.sequences.images[sequence] + length[:, None] * heading
    own = wall_factors(segments, exponent)[chosen] * length ** (-2.0 * exponent)
    total = np.array([np.sum(10.0 ** (0.1 * exponent * station.paths(place).gain_db)) for place in position])
    inside = twin.free_space.contains(position)
    return Places(position=position[inside], own=own[inside], total=np.maximum(total, own)[inside])


def look_up(prior: PathPrior, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of the map at places."""
    index = np.floor((position - prior.origin) / prior.voxel_size).astype(int)
    index = np.clip(index, 0, np.array(prior.total.shape) - 1)
    return np.asarray(prior.total[index[:, 0], index[:, 1], index[:, 2]])


def study(name: str, site: SiteFile, twin: Twin, count: int, seed: int) -> NDArray[np.float64]:
    """Judge all maps of a site; shape (spacings, refinements, 3)."""
    places = draw_places(site, twin, count, np.random.default_rng(seed))
    expected = places.own / places.total
    print(f"{name}: {len(places.own)} places, mean pi {expected.mean():.3f}")
    print("  rays [deg]  voxel [m]   error of ln(total): median  |.| 90 %   no ray   weight put wrong")
    found = np.zeros((len(SPACINGS_DEG), len(REFINEMENTS), 3))
    for i, degrees in enumerate(SPACINGS_DEG):
        rays, segments = launch_rays(site.stations[0], site, twin, np.deg2rad(degrees), np.random.default_rng(seed + 1))
        for j, refinement in enumerate(REFINEMENTS):
            prior = fill_path_prior(
                rays,
                segments,
                twin.free_space,
                exponent=site.propagation.path_prior_exponent,
                refinement=refinement,
            )
            total = look_up(prior, places.position)
            error = np.log(np.maximum(total, 1e-30) / places.total)
            pi = places.own / np.maximum(total, places.own)
            wrong = np.abs(pi - expected).sum() / expected.sum()
            found[i, j] = np.median(error), np.percentile(np.abs(error), 90), wrong
            print(
                f"  {degrees:10.2f} {prior.voxel_size:10.2f} {found[i, j, 0]:27.3f} {found[i, j, 1]:9.3f} "
                f"{np.mean(total == 0.0):8.1%} {wrong:18.1%}",
                flush=True,
            )
    return found


def plot(results: dict[str, NDArray[np.float64]], path: Path) -> None:
    """Draw the weight put wrong against the rays' spacing, one line a voxel size."""
    mpl.use("agg")
    import matplotlib.pyplot as plt  # after the backend is chosen

    mpl.rcParams["svg.hashsalt"] = "rayfix"
    figure, axes = plt.subplots(1, len(results), figsize=(1.5 + 4.2 * len(results), 3.8), squeeze=False, sharey=True)
    for panel, (name, found) in zip(axes[0], results.items(), strict=True):
        for j, refinement in enumerate(REFINEMENTS):
            panel.plot(SPACINGS_DEG, found[:, j, 2], "o-", label=f"voxels of {0.1 * refinement:g} m")
        panel.set(title=name, xscale="log", yscale="log", xlabel="spacing of the rays [deg]")
        panel.set_xticks(SPACINGS_DEG, [f"{degrees:g}" for degrees in SPACINGS_DEG], minor=False)
        panel.set_xticks([], minor=True)
        panel.grid(alpha=0.3, which="both")
    axes[0, 0].set_ylabel("share of the rays' weight put wrong")
    axes[0, -1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


if __name__ == "__main__":
    main()
