"""Real UWB ranges without angles: accuracy against motion capture, compared with least squares (docs/real-data.md).

The twin is an empty room around eight anchors. The first quarter of the run determines each anchor's bias and the
standard deviation of the ranges. After a gap of a twentieth, the rest is evaluated. "One wrong" adds 3 m to one range
of eight, drawn at random, as a blocked path would.
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.recorded.uwb_recordings import ANCHORS, Ranging, least_squares, read_ranging, site_text
from rayfix_evaluation.drops.calibration import ellipsoid_holds
from rayfix_offline.build import build_table
from rayfix_service.fusion.measurements.report import Height, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

Array = NDArray[np.float64]

ROOM = ((-4.5, -4.0, 0.0), (4.5, 4.0, 3.0))  # m
CALIBRATION, HELD_OUT = (0.0, 0.25), (0.3, 1.0)  # shares of the run
DETOUR = 3.0  # m
HEIGHT_STDEV = 0.02  # m, where the height is known
VARIANTS = (("", "sound"), (", one wrong", "spoilt"))
FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "uwb"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=FOLDER, help="folder of the data set")
    parser.add_argument("--reports", type=int, default=100, help="moments, evenly spaced; each has three tags")
    parser.add_argument("--windows", type=float, nargs="+", default=[8.0, 15.0], help="of the tables, deg")
    parser.add_argument("--beam", type=int, default=FusionSettings().beam_width, help="hypotheses that are kept")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--plot", type=Path, help="picture of the last window's fixes")
    options = parser.parse_args()
    ranging = read_ranging(options.data)
    calibration, rest = ranging.part(*CALIBRATION), ranging.part(*HELD_OUT)
    bias = np.nanmedian(calibration.residuals(), axis=(0, 2))
    stdev = float(np.nanstd(calibration.residuals() - bias[:, None]))
    height = float(calibration.truth[..., 2].mean())
    print(
        f"{len(ranging)} moments; bias of the anchors {np.array2string(bias, precision=2)} m, deviation {stdev:.3f} m"
    )
    samples = take(rest, options.reports, options.seed)
    print(f"{'':42}horizontal error [m]        error [m]     in the ellipsoid of     fix")
    print(f"{'':42}50 %   90 %   99 %    RMS   50 %   90 %   50 %    90 %    99 %    [ms]")
    found: dict[str, Array] = {}

    def show(label: str, places: list[Array], more: str = "") -> None:
        found[label] = np.array([place - sample.truth for place, sample in zip(places, samples, strict=True)])
        print(f"{label:39} {columns(found[label])}{more}", flush=True)

    for label, known in (("least squares", None), ("same, height known", height)):
        for name, ranges in VARIANTS:
            places = [
                least_squares(ANCHORS[s.heard], (getattr(s, ranges) - bias)[s.heard], height=known) for s in samples
            ]
            show(label + name, places)
    settings = FusionSettings(beam_width=options.beam)
    with tempfile.TemporaryDirectory() as folder:
        for window in options.windows:
            locator = Locator(anchor_table(Path(folder), bias, window), settings)
            locator.warm_up()
            prior = Height(z=height, stdev=HEIGHT_STDEV)
            table = f"rayfix {window:g} deg"
            for label, known_height in ((table, None), (f"{table}, height known", prior)):
                for name, ranges in VARIANTS:
                    fixes, seconds = locate(locator, samples, ranges, stdev, known_height)
                    places = [np.full(3, np.inf) if fix.position is None else fix.position for fix in fixes]
                    inside = [held(fixes, samples, probability) for probability in (0.5, 0.9, 0.99)]
                    shares = "  ".join(f"{share:6.0%}" for share in inside)
                    show(label + name, places, f" {shares} {1e3 * seconds:8.1f}")
    if options.plot is not None:
        last = f"rayfix {options.windows[-1]:g} deg"
        draw(options.plot, samples, found, last)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Ranges of one tag at one moment, with their bias; those of anchors that did not hear are NaN.

    Attributes
    ----------
    sound, spoilt : ndarray of shape (n_anchors,), m
        As measured, and with one too long.
    heard : ndarray of bool, shape (n_anchors,)
    truth : ndarray of shape (3,), m
    """

    sound: Array
    spoilt: Array
    heard: NDArray[np.bool_]
    truth: Array


def take(ranging: Ranging, count: int, seed: int) -> list[Sample]:
    """Take evenly spaced moments, all tags of each."""
    rng = np.random.default_rng(seed)
    samples = []
    for n in np.linspace(0, len(ranging) - 1, count).astype(int):
        for tag in range(ranging.measured.shape[2]):
            sound = ranging.measured[n, :, tag]
            heard = np.isfinite(sound)
            spoilt = sound.copy()
            spoilt[rng.choice(np.flatnonzero(heard))] += DETOUR
            samples.append(Sample(sound=sound, spoilt=spoilt, heard=heard, truth=ranging.truth[n, tag]))
    return samples


def anchor_table(folder: Path, bias: Array, window: float) -> Table:
    """Build the table of the anchors in their empty room."""
    room = trimesh.creation.box(bounds=ROOM)
    room.invert()
    (folder / "room.glb").write_bytes(trimesh.Scene(room).export(file_type="glb"))
    site = folder / f"site_{window:g}.toml"
    site.write_text(site_text("room.glb", bias, window_deg=window), encoding="utf-8")
    build_table(site, site.with_suffix(".h5"))
    return Table.open(site.with_suffix(".h5"))


def locate(
    locator: Locator, samples: list[Sample], ranges: str, stdev: float, height: Height | None
) -> tuple[list[Fix], float]:
    """Locate all samples by one kind of their ranges; with the fixes comes the median of their seconds."""
    fixes, seconds = [], []
    for sample in samples:
        lengths = getattr(sample, ranges)
        report = Report(
            measurements=tuple(
                Range(station_id=f"a{n}", path_length=float(lengths[n]), stdev=stdev)
                for n in np.flatnonzero(sample.heard)
            ),
            height=height,
        )
        begin = perf_counter()
        fixes.append(locator.locate(report))
        seconds.append(perf_counter() - begin)
    return fixes, float(np.median(seconds))


def held(fixes: list[Fix], samples: list[Sample], probability: float) -> float:
    """Share of the fixes whose credible ellipsoid holds the truth."""
    inside = [
        bool(fix.candidates) and ellipsoid_holds(fix, probability, sample.truth)
        for fix, sample in zip(fixes, samples, strict=True)
    ]
    return float(np.mean(inside))


def columns(apart: Array) -> str:
    level, whole = np.hypot(apart[:, 0], apart[:, 1]), np.linalg.norm(apart, axis=1)
    values = [
        *np.percentile(level, [50, 90, 99], method="inverted_cdf"),
        np.sqrt(np.mean(level**2)),
        *np.percentile(whole, [50, 90], method="inverted_cdf"),
    ]
    return " ".join(f"{value:6.3f}" for value in values)


def draw(path: Path, samples: list[Sample], found: dict[str, Array], label: str) -> None:
    """Draw fixes in the room from above, and how the horizontal errors are spread."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    plan, spread = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    truth = np.array([sample.truth for sample in samples])
    place = truth + found[label]
    plan.plot(*ANCHORS[:, :2].T, "^", color="#2b2f36", label="anchor")
    plan.plot(*truth[:, :2].T, "+", color="#1a936f", markersize=7, label="motion capture")
    plan.plot(*place[:, :2].T, "o", color="#d1495b", markersize=2.5, label="rayfix")
    plan.set_aspect("equal")
    plan.set_xlabel("x [m]")
    plan.set_ylabel("y [m]")
    plan.legend(loc="upper left", fontsize=8)
    lines = [("least squares", "#3b7dd8", "-"), (label, "#d1495b", "-")]
    lines += [(f"{name}, one wrong", colour, "--") for name, colour, _ in lines]
    for name, colour, style in lines:
        level = np.sort(np.hypot(found[name][:, 0], found[name][:, 1]))
        share = np.arange(1, len(level) + 1) / len(level)
        spread.plot(level, share, color=colour, linestyle=style, label=name)
    spread.set_xscale("log")
    spread.set_xlabel("horizontal error [m]")
    spread.set_ylabel("share of the fixes")
    spread.grid(alpha=0.3)
    spread.legend(fontsize=8)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
