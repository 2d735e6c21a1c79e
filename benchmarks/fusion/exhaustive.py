"""The beam against the exhaustive product, on reports of all kinds.

Each factor is reduced to about twelve alternatives that are likely near the true position, and the outlier. All
products, tens of thousands per report, are then computed by plain NumPy. The default beam search runs on the same
factors. Printed are the differences of the report's evidence and of the posterior's mean and width.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly
from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report
from rayfix_service.fusion.measurements.observations import sort_report
from rayfix_service.fusion.product.beam import multiply
from rayfix_service.fusion.product.factors import Factor, make_factor
from rayfix_service.fusion.product.information_form import unpack
from rayfix_service.fusion.product.prior import Prior, uniform_prior
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.wire import parse_report
from tests.support.oracles import kernel_twins

Array = NDArray[np.float64]
Measurements = list[dict[str, Any]]

RANGE_STDEV = 0.5
NEAR = 0.5  # m: where alternatives must be likely to be kept
UNMERGED = FusionSettings(max_divergence=0.0)
DEFAULT = FusionSettings()


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--reports", type=int, default=1000, help="of all kinds together")
    parser.add_argument("--products", type=int, default=30_000, help="most of a report")
    options = parser.parse_args()
    with open_or_build(options.table) as table, threadpool_limits(limits=1):
        count = math.ceil(options.reports / len(KINDS))
        drops = drop_uniformly(table, 2 * count, np.random.default_rng([options.seed, 0]))
        drops = [drop for drop in drops if len(drop.paths) > 1][:count]
        stations = {name: StationMixtures(part) for name, part in table.parts.items()}
        print(f"{len(drops)} reports of each kind; changes of the log evidence [nats], of the mean [posterior's")
        print("deviations] and of the deviation [shares of it]")
        print("                       evidence                  mean                      deviation")
        print("measured               50 %     99 %     most    50 %     99 %     most    50 %     99 %     most")
        for kind, (label, timing, degrees, change) in enumerate(KINDS):
            changes = []
            for n, drop in enumerate(drops):
                angle = math.radians(degrees)
                noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=RANGE_STDEV)
                rng = np.random.default_rng([options.seed, kind, n])
                report = simulate_report(drop.paths, noise, rng=rng, timing=timing)
                report["measurements"] = change(report["measurements"])
                changes.append(changes_of(table, stations, report, drop, options.products))
            values = np.percentile(np.abs(changes), [50, 99, 100], axis=0).T
            print(f"{label:20} " + " ".join(f"{value:8.5f}" for value in values.ravel()), flush=True)


def everything(measurements: Measurements) -> Measurements:
    return measurements


def times_alone(measurements: Measurements) -> Measurements:
    return [m for m in measurements if m["type"] != "aoa"]


def azimuths_alone(measurements: Measurements) -> Measurements:
    return [{key: value for key, value in m.items() if not key.startswith("zenith")} for m in measurements]


def heavy_tails(measurements: Measurements) -> Measurements:
    return [{**m, "error_model": "heavy_tailed"} for m in measurements]


def something_else_each(measurements: Measurements) -> Measurements:
    """Of one station the angles, of the next the time, of the third both, of the fourth the azimuth, and so on."""
    names = list(dict.fromkeys(m["station_id"] for m in measurements))
    kept = []
    for m in measurements:
        turn = names.index(m["station_id"]) % 4
        if (m["type"] == "aoa" and turn != 1) or (m["type"] != "aoa" and turn in (1, 2)):
            kept += azimuths_alone([m]) if turn == 3 else [m]
    return kept


KINDS: list[tuple[str, Timing, float, Callable[[Measurements], Measurements]]] = [
    ("AoA 0.25 deg + PT", "pt", 0.25, everything),
    ("AoA 1 deg", "none", 1.0, everything),
    ("AoA 1 deg + PT", "pt", 1.0, everything),
    ("AoA 1 deg + ToA", "toa", 1.0, everything),
    ("AoA 1 deg + TDoA", "tdoa", 1.0, everything),
    ("AoA 5 deg + PT", "pt", 5.0, everything),
    ("azimuth 1 deg + PT", "pt", 1.0, azimuths_alone),
    ("heavy tails, 1 deg", "pt", 1.0, heavy_tails),
    ("PT", "pt", 1.0, times_alone),
    ("TDoA", "tdoa", 1.0, times_alone),
    ("each another", "pt", 1.0, something_else_each),
]
"""What is measured: label, times, deviation of angles, and what becomes of the measurements."""


def changes_of(
    table: Any, stations: dict[str, StationMixtures], report: dict[str, Any], drop: Drop, products: int
) -> tuple[float, float, float]:
    """Tell how the beam changes the log evidence, the mean (in deviations) and the deviation (as a share)."""
    sorted_report = sort_report(parse_report(report), table.site)
    prior, longest = uniform_prior(table.scene.free_space), table.site.max_path_length
    made = [
        make_factor(
            observation,
            stations[observation.station_id],
            num_clocks=sorted_report.num_clocks,
            max_path_length=longest,
            prior=prior,
            settings=UNMERGED,
        )
        for observation in sorted_report.observations
    ]
    factors = [factor for factor in made if factor is not None]
    most = max(2, int(products ** (1.0 / len(factors))) - 1)
    factors = [likeliest(factor, drop.position, most, prior, math.log(longest)) for factor in factors]
    log_weight, mean, cov = exhaustive(factors, sorted_report.num_clocks, prior, math.log(longest))
    found = multiply(
        factors,
        max_path_length=longest,
        prior=prior,
        width=DEFAULT.beam_width,
        max_divergence=DEFAULT.max_divergence,
    )
    log_sum, centre, width = moments(log_weight, mean, cov)
    found_sum, found_centre, found_width = moments(found.log_weight, found.mean, found.cov)
    return found_sum - log_sum, float(np.linalg.norm(found_centre - centre)) / width, found_width / width - 1.0


def likeliest(factor: Factor, place: Array, most: int, prior: Prior, log_range: float) -> Factor:
    """Those of a factor's alternatives that are likely near a place, and the outlier."""
    information, eta, log_scale = unpack(factor.columns)
    near = np.zeros_like(information[0])
    near[[0, 1, 2], [0, 1, 2]] = NEAR**-2
    score = kernel_twins.log_integral(
        information + near, eta + near[:, :3] @ place, log_scale, prior.log_volume, log_range
    )
    keep = np.append(np.argsort(-score[:-1], kind="stable")[:most], len(factor) - 1)
    return Factor(columns=factor.columns[:, keep], outlier=factor.outlier[keep])


def exhaustive(factors: list[Factor], num_clocks: int, prior: Prior, log_range: float) -> tuple[Array, Array, Array]:
    """Log weights, mean positions and covariances of all products that tell of the position."""
    size = 3 + num_clocks
    information, eta = np.zeros((1, size, size)), np.zeros((1, size))
    log_scale = np.full(1, -prior.log_volume - num_clocks * log_range)
    for factor in factors:
        other_information, other_eta, other_scale = unpack(factor.columns)
        information = (information[:, None] + other_information).reshape(-1, size, size)
        eta = (eta[:, None] + other_eta).reshape(-1, size)
        log_scale = (log_scale[:, None] + other_scale).ravel()
    placed = information[:, 0, 0] > 0.0
    information, eta, log_scale = information[placed], eta[placed], log_scale[placed]
    log_weight = kernel_twins.log_integral(information, eta, log_scale, prior.log_volume, log_range)
    unknown = np.diagonal(information, axis1=1, axis2=2) <= 0.0
    cov = np.asarray(np.linalg.inv(information + unknown[:, None] * np.eye(size)), np.float64)
    return log_weight, np.einsum("hij,hj->hi", cov, eta)[:, :3], cov[:, :3, :3]


def moments(log_weight: Array, mean: Array, cov: Array) -> tuple[float, Array, float]:
    """Logarithm of the sum of a mixture's weights, its mean, and the root of the sum of its variances."""
    log_sum = float(np.logaddexp.reduce(log_weight))
    share = np.exp(log_weight - log_sum)
    centre = share @ mean
    variance = share @ (np.trace(cov, axis1=1, axis2=2) + ((mean - centre) ** 2).sum(axis=1))
    return log_sum, centre, math.sqrt(float(variance))


if __name__ == "__main__":
    main()
