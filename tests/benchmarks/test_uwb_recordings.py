"""Reading the UWB data set, and least squares on ranges."""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recorded.uwb_recordings import ANCHORS, TAGS, least_squares, read_ranging, site_text
from rayfix_offline.site import read_site
from rayfix_tables.errors import RayfixError

BEGIN = datetime(2022, 8, 15, 9, 42, 24)


def stamp(seconds: float) -> str:
    moment = (BEGIN + timedelta(seconds=seconds)).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
    return moment.replace(" 0", " ")  # hours without a leading zero, as in the data set


def write(folder: Path, turn_rate: float = 0.5) -> None:
    """Write of a trolley that rolls along x at 0.4 m/s and turns; ranges are true ones and 0.2 m, one is missing."""
    motion = ["time,x,y,z,rotation,,,"]
    for n in range(101):
        t = 0.05 * n
        half = 0.5 * turn_rate * t
        # The sign of a quaternion means nothing.
        sign = -1.0 if n % 7 == 0 else 1.0
        real, about_z = sign * float(np.cos(half)), sign * float(np.sin(half))
        motion.append(f"{stamp(t)},{0.4 * t!r},1.0,0.96,0.0,{real!r},{about_z!r},0.0")
    ranges = []
    for n in range(20):
        t = 0.12 + 0.2 * n
        tags = trolley(t, turn_rate)
        fields = [f"{0.2 + np.linalg.norm(anchor - tag):.6f}" for anchor in ANCHORS for tag in tags]
        if n == 3:
            fields[4] = ""
        ranges.append(",".join([stamp(t), *fields]))
    (folder / "motion_capture_dynamic_exp_fast.csv").write_text("\n".join(motion), encoding="utf-8")
    (folder / "UWB_dynamic_exp_fast.csv").write_text("\n".join(ranges), encoding="utf-8")


def trolley(t: float, turn_rate: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Give the true positions of the tags, shape (3, 3), m."""
    c, s = np.cos(turn_rate * t), np.sin(turn_rate * t)
    return np.array([0.4 * t, 1.0, 0.96]) + TAGS @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T


def test_truth_is_interpolated_and_turned(tmp_path: Path) -> None:
    write(tmp_path)
    ranging = read_ranging(tmp_path)
    assert ranging.measured.shape == (20, 8, 3)
    expected = np.array([trolley(0.12 + t, 0.5) for t in ranging.time])
    np.testing.assert_allclose(ranging.truth, expected, rtol=0, atol=1e-6)
    residuals = ranging.residuals()
    assert np.argwhere(np.isnan(residuals)).tolist() == [[3, 1, 1]]
    np.testing.assert_allclose(residuals[np.isfinite(residuals)], 0.2, rtol=0, atol=1e-5)


def test_parts_do_not_share_reports(tmp_path: Path) -> None:
    write(tmp_path)
    ranging = read_ranging(tmp_path)
    first, last = ranging.part(0.0, 0.25), ranging.part(0.3, 1.0)
    assert 3 <= len(first) <= 6
    assert first.time.max() < last.time.min()


def test_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RayfixError, match="cannot be read"):
        read_ranging(tmp_path)
    (tmp_path / "UWB_dynamic_exp_fast.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(RayfixError, match="is not as expected"):
        read_ranging(tmp_path)


@pytest.mark.parametrize("height", [None, 0.4])
def test_least_squares_finds_the_point_that_exact_ranges_name(height: float | None) -> None:
    point = np.array([1.3, -0.8, 0.4])
    ranges = np.linalg.norm(ANCHORS - point, axis=1)
    np.testing.assert_allclose(least_squares(ANCHORS, ranges, height=height), point, rtol=0, atol=1e-5)


def test_least_squares_has_the_least_squares() -> None:
    rng = np.random.default_rng(1)
    point = np.array([-1.1, 0.7, 0.3])
    ranges = np.linalg.norm(ANCHORS - point, axis=1) + rng.normal(size=8) * 0.1
    found = least_squares(ANCHORS, ranges)

    def cost(x: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
        return float(np.sum((np.linalg.norm(ANCHORS - x, axis=1) - ranges) ** 2))

    for step in 0.01 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert cost(found) < cost(found + step)


def test_the_site_has_all_anchors(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(site_text("room.glb", np.arange(8) / 10.0, window_deg=8.0), encoding="utf-8")
    site = read_site(tmp_path / "site.toml")
    np.testing.assert_allclose([s.position_m for s in site.stations], ANCHORS, rtol=0, atol=1e-4)
    np.testing.assert_allclose([s.bias.range_m for s in site.stations], np.arange(8) / 10.0, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_real_ranges_scatter_by_centimetres(shared_data: Path) -> None:
    """With the tags where the motion capture has them; by the named order of the quaternion it would be 0.23 m."""
    residuals = read_ranging(shared_data / "uwb").residuals()
    bias = np.nanmedian(residuals, axis=(0, 2))
    assert np.nanstd(residuals - bias[:, None]) < 0.1
