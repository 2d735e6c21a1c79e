"""Accuracy of tables on reports whose paths Sionna RT found, beside robust least squares on straight paths.

``benchmarks.truth.sionna_drops`` writes the drops. Each station reports its strongest path if that is within 40 dB of
the best station's. ``--table NAME=FILE`` (repeated) compares tables that are there; ``--build`` makes two of the site:
one whose walls are opaque, and one whose walls let signals through, without the excess length that Sionna RT leaves
out. ``--unmodelled`` sets how probable paths are that the table does not know; ``--specular`` asks the same places in
the world of the first table, whose paths are straight and reflected.
"""

import argparse
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from rayfix.example.files import write_example
from rayfix_evaluation.baselines.line_of_sight import LineOfSight
from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_evaluation.drops.calibration import ellipsoid_holds, wilson_interval
from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report
from rayfix_evaluation.truth.forward import Paths
from rayfix_offline.build import build_table
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report
from rayfix_tables.checked import open_checked
from rayfix_tables.geometry.angles import angles_of, direction
from rayfix_tables.table import Table

Array = NDArray[np.float64]

CASES: tuple[tuple[float, Timing], ...] = ((1.0, "pt"), (1.0, "none"), (1.0, "tdoa"), (0.25, "pt"))
RANGE_STDEV = 0.5  # m
HEARD_DB = 40.0
"""A station whose strongest path is weaker than the best station's by more reports nothing."""
REGION = 0.9
_HEADING = "table            angles  times     50 %    90 %  above 1 m   90 % regions hold    inconsistent  no position"
_KINDS = ("opaque", "transmission")
_WAYS = {
    (False, False): "unobstructed",
    (False, True): "straight through walls",
    (True, False): "reflected",
    (True, True): "reflected and through walls",
}
"""Ways of paths, by whether they are reflected and whether they pass walls."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Question:
    """A report and the true position of its transmitter, shape (3,), m."""

    truth: Array
    report: Report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drops", type=Path, help="the file of benchmarks.truth.sionna_drops")
    parser.add_argument("--table", action="append", default=[], metavar="NAME=FILE", help="a table to compare")
    parser.add_argument("--build", type=Path, metavar="FOLDER", help="where to build opaque.h5 and transmission.h5")
    parser.add_argument("--kinds", nargs="+", choices=_KINDS, default=_KINDS, help="which of the two to build")
    parser.add_argument("--site", type=Path, help="the site of the tables to build; a bundled example when left out")
    parser.add_argument("--example", choices=["office", "hall"], default="office")
    parser.add_argument("--jobs", type=int, default=1, help="processes of the builds")
    parser.add_argument("--unmodelled", type=float, help="prior probability of paths that the table does not know")
    parser.add_argument("--specular", action="store_true", help="also reports by the first table's image method")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    files = {}
    for item in options.table:
        name, _, path = item.partition("=")
        if not path:
            parser.error(f"--table {item}: give NAME=FILE")
        files[name] = Path(path)
    if options.build is not None:
        files |= build_tables(options.build, options.site, options)
    if not files:
        parser.error("there is nothing to compare; give --table or --build")
    drops = np.load(options.drops)
    told = reported_share(drops)
    silent = sum(not strongest(drops, number) for number in range(len(drops["position"])))
    print(f"{len(drops['position'])} drops, {silent} of them heard by no station; of the reported paths {told}")
    settings = FusionSettings()
    if options.unmodelled is not None:
        settings = replace(settings, unmodelled_probability=options.unmodelled)
    with opened(files) as tables:
        first = next(iter(tables.values()))
        worlds: dict[str, Mapping[str, Array]] = {"Sionna RT": drops}
        if options.specular:
            worlds["image method"] = specular_drops(drops["position"], first)
        for world, found in worlds.items():
            print(f"reports by {world}")
            print(_HEADING)
            for degrees, timing in CASES:
                questions = ask(found, first, degrees, timing, options.seed)
                for name, table in tables.items():
                    print(f"{name:16} {degrees:5.2f}   {timing:5} {located(table, questions, settings)}", flush=True)
                print(f"{'robust LOS':16} {degrees:5.2f}   {timing:5} {straight(first, questions)}")


def build_tables(folder: Path, site: Path | None, options: argparse.Namespace) -> dict[str, Path]:
    """Build the site's table with opaque walls, and with walls that let signals through, where they are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    source = site or write_example(folder / "site", example=options.example)
    document = tomllib.loads(source.read_text(encoding="utf-8"))
    document["site"]["scene"] = str((source.parent / document["site"]["scene"]).resolve())
    found = {}
    for name in options.kinds:
        found[name] = folder / f"{name}.h5"
        if found[name].exists():
            continue
        document.setdefault("propagation", {}).update(transmission=name == "transmission", excess_length=False)
        changed = folder / f"{name}.toml"
        changed.write_text(tomli_w.dumps(document), encoding="utf-8")
        summary = build_table(changed, found[name], jobs=options.jobs)
        print(f"{name}: {summary.num_bytes / 1e6:.0f} MB in {summary.seconds:.0f} s", flush=True)
    return found


@contextmanager
def opened(files: Mapping[str, Path]) -> Iterator[dict[str, Table]]:
    """Open and check tables."""
    yield {name: open_checked(path) for name, path in files.items()}


def strongest(drops: Mapping[str, Array], number: int) -> dict[int, int]:
    """Stations that report a drop, by index, and the index of their path."""
    best = drops["gain_db"][number].max(axis=1)
    heard = np.isfinite(best) & (best >= best.max() - HEARD_DB)
    return {int(s): int(drops["gain_db"][number, s].argmax()) for s in np.flatnonzero(heard)}


def reported_share(drops: Mapping[str, Array]) -> str:
    """Shares of the kinds of paths that are reported."""
    kinds = []
    for number in range(len(drops["position"])):
        for s, k in strongest(drops, number).items():
            bounced = bool(drops["num_reflections"][number, s, k])
            passed = bool(drops["num_walls"][number, s, k])
            kinds.append("diffracted or scattered" if drops["others"][number, s, k] else _WAYS[bounced, passed])
    names = (*_WAYS.values(), "diffracted or scattered")
    return ", ".join(f"{kinds.count(name) / max(len(kinds), 1):.1%} {name}" for name in names)


def ask(drops: Mapping[str, Array], table: Table, degrees: float, timing: Timing, seed: int) -> list[Question]:
    """Make a report of each drop that a station hears; the same draws whatever the deviations."""
    stations = table.site.stations
    if drops["gain_db"].shape[1] != len(stations):
        raise ValueError(f"the drops have {drops['gain_db'].shape[1]} stations and the table {len(stations)}")
    angle = float(np.deg2rad(degrees))
    noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=None if timing == "none" else RANGE_STDEV)
    questions = []
    for number, truth in enumerate(drops["position"]):
        paths = {stations[s].id: path_of(drops, number, s, k) for s, k in strongest(drops, number).items()}
        if not paths:
            continue
        report = simulate_report(paths, noise, rng=np.random.default_rng([seed, 1, number]), timing=timing)
        questions.append(Question(truth=truth, report=parse_report(report)))
    return questions


def path_of(drops: Mapping[str, Array], number: int, station: int, index: int) -> Paths:
    """Return a path as reports are made of it; its vertices are not known."""
    row = (number, station, slice(index, index + 1))
    azimuth, zenith = angles_of(drops["direction"][row])
    return Paths(
        path_length=drops["path_length"][row],
        azimuth=azimuth,
        zenith=zenith,
        num_reflections=drops["num_reflections"][row].astype(np.int64),
        num_walls=drops["num_walls"][row].astype(np.int64),
        gain_db=drops["gain_db"][row],
        vertices=np.zeros((1, 0, 3)),
        crossings=np.zeros((1, 0, 3)),
    )


def specular_drops(positions: Array, table: Table) -> dict[str, Array]:
    """Strongest path of each link by the image method on a table's triangles, as the file of drops has them."""
    stations = table.site.stations
    solvers = [solver_of(table).station(station.position) for station in stations]
    shape = (len(positions), len(stations), 1)
    gain, length, heading = np.full(shape, -np.inf), np.zeros(shape), np.zeros((*shape, 3))
    counts = {name: np.zeros(shape, np.int64) for name in ("num_reflections", "num_walls", "others")}
    for n, position in enumerate(positions):
        for s, solver in enumerate(solvers):
            paths = solver.paths(position)
            if len(paths):
                best = paths.only(int(paths.gain_db.argmax()))
                gain[n, s], length[n, s] = best.gain_db, best.path_length
                heading[n, s] = direction(best.azimuth, best.zenith)
                counts["num_reflections"][n, s], counts["num_walls"][n, s] = best.num_reflections, best.num_walls
    return {"position": positions, "gain_db": gain, "path_length": length, "direction": heading, **counts}


def located(table: Table, questions: list[Question], settings: FusionSettings) -> str:
    """Figures of a table's fixes."""
    locator = Locator(table, settings)
    locator.warm_up()
    fixes = [locator.locate(question.report) for question in questions]
    errors = [
        np.inf if fix.position is None else float(np.linalg.norm(fix.position - question.truth))
        for fix, question in zip(fixes, questions, strict=True)
    ]
    stated = [(fix, q.truth) for fix, q in zip(fixes, questions, strict=True) if fix.regions is not None]
    held = sum(ellipsoid_holds(fix, REGION, truth) for fix, truth in stated)
    low, high = wilson_interval(held, len(stated))
    inconsistent = sum(fix.status == "inconsistent" for fix in fixes) / len(fixes)
    return (
        f"{summary(errors)}   {held / max(len(stated), 1):5.1%} ({low:.0%} to {high:.0%}) {inconsistent:14.1%}"
        f" {np.mean(~np.isfinite(errors)):11.1%}"
    )


def straight(table: Table, questions: list[Question]) -> str:
    """Figures of robust least squares on all measurements."""
    vertices = np.asarray(table.scene.vertices, np.float64)
    bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    method = LineOfSight(site=table.site, bounds=bounds, kinds=("angles", "ranges", "differences"), robust=True)
    errors = []
    for question in questions:
        found = method.locate(question.report)
        errors.append(np.inf if found is None else float(np.linalg.norm(found - question.truth)))
    return f"{summary(errors)} {'':>36} {np.mean(~np.isfinite(errors)):11.1%}"


def summary(errors: list[float]) -> str:
    """Quantiles of the errors, m, and the share above one metre."""
    half, most = np.quantile(errors, [0.5, 0.9], method="inverted_cdf")
    return f"{half:7.3f} {most:7.3f} {np.mean(np.array(errors) > 1.0):10.1%}"


if __name__ == "__main__":
    main()
