"""Pictures of reports: densities on a grid against closed forms, and what is drawn against what is known."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from scipy.stats import multivariate_normal

from rayfix.cli import main
from rayfix_evaluation.pictures.density import credible_levels, marginal_density
from rayfix_evaluation.pictures.files import save_picture, set_plan_limits
from rayfix_evaluation.pictures.plot import make_figure
from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table
from tests.support.messages.reports import REPORT


def test_a_marginal_is_the_mixture_of_the_marginals():
    rng = np.random.default_rng(1)
    weight, mean = np.array([0.3, 0.7]), rng.normal(size=(2, 3))
    roots = rng.normal(size=(2, 3, 3))
    cov = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3)
    x, y = np.linspace(-2, 2, 5), np.linspace(-1, 3, 4)
    found = marginal_density(weight, mean, cov, (2, 0), x, y)
    places = np.stack(np.meshgrid(x, y), axis=-1)
    pick = np.ix_([2, 0], [2, 0])
    expected = sum(
        w * multivariate_normal(m[[2, 0]], c[pick]).pdf(places) for w, m, c in zip(weight, mean, cov, strict=True)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_levels_hold_the_shares_of_a_gaussian():
    """Within the density p(0) (1 - share) of a Gaussian in the plane lies the share (chi-squared with two degrees)."""
    x = np.linspace(-6, 6, 601)
    density = marginal_density(np.ones(1), np.zeros((1, 3)), np.eye(3)[None], (0, 1), x, x)
    found = credible_levels(density, (0.5, 0.9))
    np.testing.assert_allclose(found, density.max() * np.array([0.1, 0.5]), rtol=0.01)
    assert credible_levels(np.zeros((3, 3)), (0.5,)) == []


def red(path: Path) -> int:
    """Count pixels in the colours of posterior and fix."""
    r, g, b = np.asarray(Image.open(path).convert("RGB")).astype(int).transpose(2, 0, 1)
    return int(((r > 180) & (g < 170) & (b < 190) & (r - g > 50)).sum())


@pytest.mark.slow
def test_the_command_draws_the_layers_that_are_asked_for(hall_table_path: Path, tmp_path: Path):
    report = tmp_path / "report.json"
    report.write_text(json.dumps(REPORT), encoding="utf-8")
    pictures = {}
    for layers in ("rays,points", "mixture", "posterior,fix"):
        picture = tmp_path / f"{layers}.png"
        assert main(["plot", str(hall_table_path), str(report), "-o", str(picture), "--layers", layers]) == 0
        pictures[layers] = picture
    assert red(pictures["posterior,fix"]) > red(pictures["mixture"]) + 500
    assert red(pictures["posterior,fix"]) > red(pictures["rays,points"]) + 500
    vector = tmp_path / "fix.svg"
    assert main(["plot", str(hall_table_path), str(report), "-o", str(vector), "--truth", "5", "14", "1"]) == 0
    assert vector.read_text(encoding="utf-8").startswith("<?xml")


def test_an_unknown_layer_is_refused(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        main(["plot", "t.h5", "r.json", "-o", "p.png", "--layers", "rays,beams"])
    assert end.value.code == 2
    assert "'beams' is not a layer" in capsys.readouterr().err


@pytest.mark.parametrize("along", [0, 1])
def test_a_plan_is_no_mirror_image(along: int):
    """To turn from x to y is to turn counter-clockwise, whichever of them runs to the right."""
    axes = Figure().subplots()
    set_plan_limits(axes, along, (-1.0, -2.0, 0.0), (3.0, 2.0, 1.0))
    points = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])[:, [along, 1 - along]]
    origin, x, y = axes.transData.transform(points)
    assert np.linalg.det([x - origin, y - origin]) > 0.0
    assert sorted(axes.get_ylim()) == [(-2.0, -1.0)[along], (2.0, 3.0)[along]]


def test_the_scene_is_seen_from_above_and_not_in_a_mirror(hall_table_path: Path):
    """To turn from x to y is to turn counter-clockwise; the hall's y runs to the right, so its x runs down."""
    table = Table.open(hall_table_path)
    (above, view), (beside, side) = make_figure(table).views
    assert (view, side) == ((1, 0), (1, 2))
    origin, x, y = above.transData.transform([(0.0, 0.0), (0.0, 1.0), (1.0, 0.0)])  # of scene points, y to the right
    assert np.linalg.det([x - origin, y - origin]) > 0.0
    low, high = beside.get_ylim()
    assert low < high


def test_a_picture_that_cannot_be_written_is_one_error(tmp_path: Path):
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(RayfixError, match=r"cannot write .*taken\.png \(Is a directory\); give another name"):
        save_picture(Figure(), tmp_path / "taken.png")
