"""Random small edits of scene files: each is read as an independent reading has it, or told of."""

import importlib.util
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rayfix_offline.scene.scene import Scene, load_scene
from rayfix_tables.errors import SceneError
from tests.support.scenes import naive_scenes
from tests.support.scenes.polygon_scene import volume
from tests.support.scenes.scene_edits import FORMATS

HAS_IFC = importlib.util.find_spec("ifcopenshell") is not None
KINDS = [
    pytest.param(kind, marks=pytest.mark.skipif(kind == "ifc" and not HAS_IFC, reason="ifcopenshell is not installed"))
    for kind in FORMATS
]


def naive(path: Path) -> tuple[int, float] | None:
    """Count triangles that have an area, and their volume, by the independent reader; None where it cannot tell."""
    reader = getattr(naive_scenes, f"read_{path.suffix[1:]}")
    try:
        polygons = reader(path)
    except Exception:  # whatever comes up
        return None
    count, kept = 0, []
    for ring in polygons:
        ring = ring[(ring != np.roll(ring, 1, axis=0)).any(axis=1)]
        if len(ring) >= 3 and np.linalg.norm(np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)) > 2e-12:
            count += len(ring) - 2
            kept.append(ring)
    return count, volume(kept)


def loaded_volume(scene: Scene) -> float:
    a, b, c = (scene.triangles[:, k] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def verdict(path: Path) -> str:
    """Say "read", "told" or "refused"; fail for anything else."""
    try:
        scene = load_scene(path)
    except SceneError as error:
        message = str(error)
    else:
        message = ""
    if message:
        assert str(path.parent) in message
        assert "\n" not in message
        return "refused"
    if scene.remarks:
        return "told"
    expected = naive(path)
    assert expected is not None, "nothing was said of what the independent reading does not understand"
    count, whole = expected
    assert len(scene.faces) == count
    assert loaded_volume(scene) == pytest.approx(whole, rel=1e-5, abs=1e-4)
    return "read"


def try_edits(kind: str, folder: Path, *, per_format: int, seed: int) -> None:
    write, names = FORMATS[kind]
    path = folder / f"scene.{kind}"
    for plain in range(3):
        write(path, np.random.default_rng(plain), None)
        assert verdict(path) == "read"
    verdicts: Counter[str] = Counter()
    for number in range(per_format):
        name = names[number % len(names)]
        write(path, np.random.default_rng([seed, number]), name)
        try:
            verdicts[verdict(path)] += 1
        except Exception as error:
            error.add_note(f"edit '{name}', number {number} of seed {seed}, of {kind}")
            raise
    assert verdicts["read"] >= per_format // 5
    assert verdicts["told"] + verdicts["refused"] >= per_format // 10


@pytest.mark.parametrize("kind", KINDS)
def test_edits(kind: str, tmp_path: Path) -> None:
    try_edits(kind, tmp_path, per_format=60, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_edits(kind: str, tmp_path: Path) -> None:
    try_edits(kind, tmp_path, per_format=200, seed=1)
