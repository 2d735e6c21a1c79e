"""The Python interface."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rayfix
from rayfix.example.drop import example_paths, report_text, simulate_example_report
from rayfix.example.files import example_report
from rayfix.example.hall import hall_scene
from rayfix_service.wire import parse_report


def test_everything_in_all_can_be_imported() -> None:
    for name in rayfix.__all__:
        assert getattr(rayfix, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        rayfix.nothing  # noqa: B018


# In half a second errors that may drift do not average out; those that are taken for independent do.
@pytest.mark.parametrize(
    ("settings", "least_gain"), [(rayfix.TrackingSettings(), 1.0), (rayfix.TrackingSettings(drift=None), 0.7)]
)
def test_a_tracker_goes_on_with_what_a_locator_fuses(
    hall_table_path: Path, settings: rayfix.TrackingSettings, least_gain: float
) -> None:
    table = rayfix.Table.open(hall_table_path)
    locator, tracker = rayfix.Locator(table), rayfix.Tracker(table, settings)
    document = json.loads(example_report())
    spreads = []
    for tenth in range(6):
        document["timestamp"] = f"2026-01-31T10:00:00.{tenth}Z"
        fused = locator.fuse(document)
        assert fused.fix.log_evidence == locator.locate(document).log_evidence
        track = tracker.follow(fused)
        assert track is not None
        spreads.append(np.trace(track.estimate.covariance))
    assert (track.state, track.num_reports) == ("updated", 6)
    assert fused.fix.position is not None
    assert np.linalg.norm(track.estimate.position - fused.fix.position) < 0.5
    assert spreads[-1] < least_gain * spreads[0]


def test_the_path_of_a_table_is_no_table(hall_table_path: Path) -> None:
    with pytest.raises(TypeError, match=r"open the file with rayfix\.Table\.open"):
        rayfix.Locator(hall_table_path)  # type: ignore[arg-type]


def test_a_locator_takes_a_dict_or_a_report(hall_table_path: Path) -> None:
    document = json.loads(example_report())
    locator = rayfix.Locator(rayfix.Table.open(hall_table_path))
    from_dict = locator.locate(document)
    assert from_dict.position is not None
    assert from_dict.target_id == "agv-7"
    wrong = json.loads(example_report())
    wrong["measurements"][0]["azimuth_deg"] = 720.0
    one, error, two = locator.locate_batch([document, wrong, parse_report(document)])
    for fix in (one, two):
        assert isinstance(fix, rayfix.Fix)
        assert fix.log_evidence == from_dict.log_evidence
    assert isinstance(error, rayfix.RayfixError)
    assert "720" in str(error)
    with pytest.raises(rayfix.RayfixError, match="720"):
        locator.locate(wrong)


def test_build_writes_beside_the_site_file(hall_site_path: Path, tmp_path: Path) -> None:
    text = hall_site_path.read_text(encoding="utf-8").replace("[2.5, 10]", "[15.0]")
    (tmp_path / "site.toml").write_text(text, encoding="utf-8")
    (tmp_path / "hall.glb").write_bytes((hall_site_path.parent / "hall.glb").read_bytes())
    table = rayfix.build(tmp_path / "site.toml")
    assert table.path == tmp_path / "site.h5"
    table.verify()
    assert [round(float(np.rad2deg(level.window)), 6) for level in table.levels("bs1")] == [15.0]


def test_build_takes_over_from_a_former_table(hall_site_path: Path, tmp_path: Path) -> None:
    """A cabinet has moved by a centimetre; within the tolerance cells of the former table are kept."""
    text = hall_site_path.read_text(encoding="utf-8").replace("[2.5, 10]", "[15.0]")
    (tmp_path / "site.toml").write_text(text, encoding="utf-8")
    (tmp_path / "hall.glb").write_bytes((hall_site_path.parent / "hall.glb").read_bytes())
    former = rayfix.build(tmp_path / "site.toml", tmp_path / "former.h5")
    scene = hall_scene()
    scene.geometry["cabinet_1"].apply_translation((0.0, 0.01, 0.0))
    (tmp_path / "hall.glb").write_bytes(scene.export(file_type="glb"))
    table = rayfix.build(tmp_path / "site.toml", tmp_path / "new.h5", former=former.path, tolerance=0.5)
    updates = [part.update for part in table.parts.values() if part.update is not None]
    assert updates
    for update in updates:
        assert update.tolerance == 0.5
        assert update.former_part_id in {part.part_id for part in former.parts.values()}
    with pytest.raises(rayfix.RayfixError, match=r"1\.5"):
        rayfix.build(tmp_path / "site.toml", tmp_path / "new.h5", tolerance=1.5)
    with pytest.raises(rayfix.RayfixError, match=r"missing\.h5"):
        rayfix.build(tmp_path / "site.toml", tmp_path / "new.h5", former=tmp_path / "missing.h5")


def test_the_bundled_report_is_what_the_forward_solver_gives() -> None:
    assert example_report() == report_text(simulate_example_report(example_paths()))


def test_a_missing_extra_is_named() -> None:
    script = (
        "import sys\n"
        "sys.modules['fastapi'] = sys.modules['numba'] = sys.modules['trimesh'] = None\n"
        "from rayfix.cli import main\n"
        "import rayfix\n"
        "print(main(['example', 'never']), main(['serve', 'never.h5']))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=100, check=True)
    assert done.stdout.strip() == "2 2"
    first, second = done.stderr.strip().splitlines()
    assert first.endswith("is not installed; install it with: pip install 'rayfix[offline]'")
    assert second.endswith("is not installed; install it with: pip install 'rayfix[service]'")
