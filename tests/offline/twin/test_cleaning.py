"""Duplicate triangles: copies, back faces, and those that must remain."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.cleaning import find_duplicates
from rayfix_offline.twin.mesh import Mesh
from rayfix_offline.twin.solids import split_parts
from tests.support.scenes.rooms import scene_of, twin_of
from tests.support.scenes.shapes import box

WriteSite = Callable[..., Path]


def cleaned(scene: Scene) -> Scene:
    """Leave the redundant triangles out."""
    mesh = Mesh(scene=scene)
    return mesh.without(find_duplicates(mesh).redundant).scene


def test_a_sound_box_has_none() -> None:
    duplicates = find_duplicates(Mesh(scene=scene_of(crate=box((0, 0, 0), (1, 2, 3)))))
    assert not duplicates.redundant.any()
    assert (duplicates.num_copies, duplicates.num_backs, duplicates.coinciding) == (0, 0, ())


def test_copies_are_left_out_whatever_corner_they_begin_at() -> None:
    crate = box((0, 0, 0), (1, 2, 3))
    scene = scene_of(crate=np.concatenate([crate, np.roll(crate[[3, 7]], 1, axis=1), crate[[3]]]))
    scene = replace(scene, face_materials=np.arange(15, dtype=np.int16))
    duplicates = find_duplicates(Mesh(scene=scene))
    assert np.flatnonzero(duplicates.redundant).tolist() == [12, 13, 14]
    assert (duplicates.num_copies, duplicates.num_backs) == (3, 0)
    left = cleaned(scene)
    np.testing.assert_array_equal(left.triangles, crate)
    np.testing.assert_array_equal(left.face_materials, np.arange(12))


def test_a_box_drawn_from_both_sides_is_solid_again() -> None:
    crate = box((0, 0, 0), (1, 2, 3))
    scene = scene_of(crate=np.concatenate([crate, crate[:, ::-1]]))
    assert find_duplicates(Mesh(scene=scene)).num_backs == 12
    (part,) = split_parts(Mesh(scene=cleaned(scene)))
    assert part.closed
    assert part.volume == pytest.approx(6.0, rel=1e-12)


def test_boxes_back_to_back_keep_the_face_between_them() -> None:
    """The two squares at x = 1 are one the back side of the other."""
    two = np.concatenate([box((0, 0, 0), (1, 1, 1)), box((1, 0, 0), (2, 1, 1))])
    for scene in (scene_of(both=two), scene_of(one=two[:12], other=two[12:])):
        duplicates = find_duplicates(Mesh(scene=scene))
        assert not duplicates.redundant.any()
        assert duplicates.coinciding == ()


def test_objects_that_coincide_are_named_and_stay() -> None:
    crate = box((0, 0, 0), (1, 2, 3))
    scene = scene_of(crate=crate, copy=crate, other=box((5, 0, 0), (6, 1, 1)))
    duplicates = find_duplicates(Mesh(scene=scene))
    assert not duplicates.redundant.any()
    assert duplicates.coinciding == (("crate", "copy"),)


@pytest.mark.parametrize("name", ["room", "cabinet"])
@pytest.mark.parametrize("backs", [False, True])
def test_the_twin_is_that_of_the_clean_scene(
    tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene, name: str, backs: bool
) -> None:
    """Walls or a cabinet that are duplicated or double-sided, as some programs export them."""
    clean = twin_of(write_site(tmp_path))
    mesh = cluttered_scene.geometry[name]
    again = mesh.faces[:, ::-1] if backs else mesh.faces
    cluttered_scene.geometry[name] = trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces, again]), process=False)
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene))
    np.testing.assert_array_equal(twin.free_space.free, clean.free_space.free)
    np.testing.assert_array_equal(twin.scene.triangles, clean.scene.triangles)
    (finding,) = twin.findings
    assert finding.kind == "duplicate"
    assert finding.problem.startswith("12 triangles are back faces" if backs else "12 duplicate triangles are removed")
