"""The identity of a station's part: every number that decides its content is in it, and no module's name."""

import ast
import dataclasses
import importlib
import json
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from rayfix_offline.job.method import FixedNumbers, Method
from rayfix_offline.job.plan import plan_build
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import Twin, prepare_twin

FOLDERS = ("scene", "twin", "rays", "fit", "job")
OF_TABLES = (
    "gaussians.conditioning",
    "gaussians.definite",
    "gaussians.normal_points",
    "gaussians.tree_reduction",
    "gaussians.triangles",
    "level",
    "grid",
    "mixture",
    "compact.tubes",
)

SETTINGS = {
    "offline.twin.settings.TwinSettings",
    "offline.rays.settings.RaySettings",
    "offline.scene.materials.ReflectionSettings",
    "offline.fit.settings.RayFit",
    "offline.fit.settings.TubeFit",
    "offline.fit.settings.ExpectationMaximisation",
    "offline.fit.settings.CoarseFit",
    "offline.fit.settings.BalanceSettings",
    "offline.job.changes.ComparisonSettings",
}
"""Classes whose fields are the identity."""

FIXED = {
    "offline.rays.voxelwalk.GAUSS": "gauss",
    "offline.rays.voxelwalk.RAY_RANGES": "ray_ranges",
    "offline.scene.materials.VACUUM_PERMITTIVITY": "vacuum_permittivity",
    "offline.scene.materials.ITU_MATERIALS": "itu_materials",
    "offline.job.changes.SMALLEST": "smallest_change",
    "tables.gaussians.normal_points.SQUARES": "normal_squares",
    "tables.gaussians.tree_reduction.SMALLEST_PIVOT": "smallest_pivot",
}
"""Constants of modules, and the field of ``FixedNumbers`` that each one is in."""

CHECK_ONLY = "findings of the check change no table"
BY_CHECKSUM = "what it decides, the scene's triangles or the free space, is in the identity itself"
DEFINITION = "part of a definition or a unit, not a choice"
SAME_BITS = "changes memory or time only, no bit of the table"

WAITING = "how long something is waited for"

NOT_IN_IDENTITY = {
    "offline.scene.room._SIDES": "shapes the scene, which has a hash of its own",
    "offline.scene.room.wall_remarks": "only words a remark",
    "offline.job.cluster.LOOK_SECONDS": WAITING,
    "offline.job.cluster_workers.ANSWER_SECONDS": WAITING,
    "offline.job.cluster_workers.LEFT_SECONDS": WAITING,
    "offline.scene.placed.MOST_TRIANGLES": "a limit on what is read; beyond it the file is refused",
    "offline.scene.polygons.FLAT": CHECK_ONLY,
    "offline.scene.polygons._IN_LINE": BY_CHECKSUM,
    "offline.scene.polygons._SAME_AREA": BY_CHECKSUM,
    "offline.scene.polygons._cut_at_corners": BY_CHECKSUM,
    "offline.scene.polygons._ears": BY_CHECKSUM,
    "offline.scene.polygons._is_fan": BY_CHECKSUM,
    "offline.scene.scene.METRES_PER_UNIT": BY_CHECKSUM,
    "offline.scene.scene.UPRIGHT": BY_CHECKSUM,
    "offline.scene.scene._MIN_AREA": BY_CHECKSUM,
    "offline.scene.scene._MOST_MATERIALS": "a limit on what is read; beyond it the file is refused",
    "offline.scene.materials.with_conductivity": DEFINITION,
    "offline.scene.slabs.SPEED_OF_LIGHT_GHZ": DEFINITION,
    "offline.scene.walls.Walls.reflected": DEFINITION,
    "offline.scene.walls.Walls.transmitted": DEFINITION,
    "offline.twin.enclosures.find_enclosures": BY_CHECKSUM,
    "offline.twin.findings.HIGH_ROOM": CHECK_ONLY,
    "offline.twin.findings.LARGE_SCENE": CHECK_ONLY,
    "offline.twin.findings.SMALL_SCENE": CHECK_ONLY,
    "offline.scene.engine.FAR": BY_CHECKSUM,
    "offline.scene.scene.COARSE": CHECK_ONLY,
    "offline.twin.findings.MOST_NAMES": CHECK_ONLY,
    "offline.twin.findings.OPAQUE_ABOVE": CHECK_ONLY,
    "offline.twin.partitions.CELL": CHECK_ONLY,
    "offline.twin.partitions.find_partitions": CHECK_ONLY,
    "offline.twin.partitions.FULL_HEIGHT": CHECK_ONLY,
    "offline.twin.partitions.HALF_DOOR": CHECK_ONLY,
    "offline.twin.partitions.LEAST_LENGTH": CHECK_ONLY,
    "offline.twin.partitions.MOST_SAMPLES": CHECK_ONLY,
    "offline.twin.partitions.ROOM_AREA": CHECK_ONLY,
    "offline.twin.partitions._samples": CHECK_ONLY,
    "offline.twin.partitions.THICKNESS": CHECK_ONLY,
    "offline.twin.partitions.UPRIGHT": CHECK_ONLY,
    "offline.twin.solids.is_inside": BY_CHECKSUM,
    "offline.twin.solids.map_free_space": BY_CHECKSUM,
    "offline.twin.solids._flip_above": BY_CHECKSUM,
    "offline.rays.lost_rays.LOST_RAYS_WARNING": CHECK_ONLY,
    "offline.rays.lost_rays.RAY_SPACING": CHECK_ONLY,
    "offline.rays.lost_rays.MAX_SEGMENTS": CHECK_ONLY,
    "offline.rays.lost_rays.CUBE_SIZE": CHECK_ONLY,
    "offline.rays.lost_rays.ENDLESS": CHECK_ONLY,
    "offline.rays.launch._Limits.mirrored": DEFINITION,
    "offline.rays.launch._Limits.of": DEFINITION,
    "offline.rays.launch._Limits.straight": DEFINITION,
    "offline.rays.pathprior.wall_factors": DEFINITION,
    "offline.rays.pathmap._LN10": DEFINITION,
    "offline.rays.pathmap._DECIBELS": DEFINITION,
    "offline.fit.moments.SIZE": DEFINITION,
    "offline.fit.moments.NUM_SUMS": DEFINITION,
    "offline.fit.normalise._CHUNK": SAME_BITS,
    "offline.fit.runnalls.LANES": SAME_BITS,
    "offline.job.cluster.CONNECT_SECONDS": SAME_BITS,
    "offline.job.cluster.RETRIES": SAME_BITS,
    "offline.job.cluster.TRACES_KEPT": SAME_BITS,
    "offline.job.plan.BUILD_VERSION": "in the identity beside the method",
    "offline.job.plan.BLOCK_CELLS": "a shard of other cells is not taken; the table has no blocks",
    "offline.job.plan.WIDE_BLOCK_CELLS": "a shard of other cells is not taken; the table has no blocks",
    "offline.job.shards._DIGEST_BYTES": DEFINITION,
    "offline.job.shards._FOLDER": "how a folder is opened",
    "offline.job.shards._REMOVAL_SECONDS": SAME_BITS,
    "tables.gaussians.normal_points.unit_points": "used by the service only",
    "tables.level.WINDOW_RATIO": "the default of window_ratio in CoarseFit and BalanceSettings",
    "tables.level.UNBALANCED": "an empty array",
    "tables.level.WIDE_RATIO": "of the look-up, not of the table",
    "tables.compact.tubes.COMPACT_FIELDS": "the table's format, whose version is in the identity",
    "tables.compact.tubes.WEIGHT_STEPS": "the table's format, whose version is in the identity",
    "tables.compact.tubes.DIAGONAL": "the table's format, whose version is in the identity",
    "tables.compact.tubes.LEAST_DIAGONAL": "the table's format, whose version is in the identity",
    "tables.compact.tubes._LARGEST": "the table's format, whose version is in the identity",
    "tables.compact.tubes._LOWER": "the table's format, whose version is in the identity",
    "tables.level.COMPACT_UNBALANCED": "an empty array",
    "tables.mixture.FIELD_SHAPES": "the table's format, whose version is in the identity",
    "tables.mixture._UPPER": "the table's format, whose version is in the identity",
    "tables.mixture._UNPACK": "the table's format, whose version is in the identity",
}
"""Numbers of modules, and functions with numbers of their own, that the identity need not have; and why."""

PLAIN = {0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 12.0}
"""Numbers of formulas, which are code: ``BUILD_VERSION`` stands for it."""


def modules() -> Iterator[tuple[str, ModuleType]]:
    """Yield the modules that decide what a table is."""
    for folder in FOLDERS:
        package = importlib.import_module(f"rayfix_offline.{folder}")
        for found in pkgutil.iter_modules(package.__path__):
            yield f"offline.{folder}.{found.name}", importlib.import_module(f"{package.__name__}.{found.name}")
    for name in OF_TABLES:
        yield f"tables.{name}", importlib.import_module(f"rayfix_tables.{name}")


def is_number(value: Any) -> bool:
    """Whether a value is a number, or holds some."""
    if isinstance(value, dict):
        return any(is_number(v) for v in value.values())
    if isinstance(value, tuple | list):
        return any(is_number(v) for v in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return is_number(list(dataclasses.asdict(value).values()))
    return isinstance(value, int | float | complex | np.ndarray) and not isinstance(value, bool)


def constants(tree: ast.Module) -> Iterator[str]:
    """Yield the names that a module assigns."""
    for node in tree.body:
        for target in [*getattr(node, "targets", []), getattr(node, "target", None)]:
            yield from (name.id for name in ast.walk(target or ast.Pass()) if isinstance(name, ast.Name))


def functions_with_numbers(node: ast.AST, path: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield functions and classes that have numbers of their own, beyond those of plain formulas."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            yield from functions_with_numbers(child, (*path, child.name))
        else:
            if path and isinstance(child, ast.Constant) and isinstance(child.value, float) and child.value not in PLAIN:
                yield ".".join(path)
            yield from functions_with_numbers(child, path)


def numbers_of_the_software() -> set[str]:
    """Collect all numbers that may decide what a table is."""
    found = set()
    for name, module in modules():
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        found |= {f"{name}.{constant}" for constant in constants(tree) if is_number(vars(module).get(constant))}
        found |= {f"{name}.{function}" for function in functions_with_numbers(tree)}
    return found


def test_every_number_is_in_the_identity_or_has_a_reason_not_to_be() -> None:
    found = numbers_of_the_software()
    assert len(found) > 40
    unknown = found - SETTINGS - set(FIXED) - set(NOT_IN_IDENTITY)
    assert not unknown, f"make a settings' field of {sorted(unknown)}, or say here why the identity need not have it"
    assert set(FIXED) | set(NOT_IN_IDENTITY) <= found, "a number that is no longer there still has a reason"


def test_a_number_that_is_added_is_found() -> None:
    tree = ast.parse(
        "STEP = 0.3\nLEFT, RIGHT = 1, 2\ndef f(x, y=0.7):\n    return 0.5 * x\nclass A:\n    b: float = 1e-3\n"
    )
    assert list(constants(tree)) == ["STEP", "LEFT", "RIGHT"]
    assert list(functions_with_numbers(tree)) == ["f", "A"]


def test_constants_that_kernels_close_over_are_in_the_identity() -> None:
    assert {field.name for field in dataclasses.fields(FixedNumbers)} == set(FIXED.values())
    held = dict(modules())
    for name, field in FIXED.items():
        module, constant = name.rsplit(".", 1)
        assert getattr(FixedNumbers(), field) == vars(held[module])[constant]


def test_all_settings_are_in_the_identity() -> None:
    of_method = {type(getattr(Method(), field.name)) for field in dataclasses.fields(Method)} - {FixedNumbers}
    classes = {name.rsplit(".", 1)[1] for name in SETTINGS} - {"RayFit"}  # the fits' base
    assert {of.__name__ for of in of_method} == classes
    identity = Method().identity()
    for field in dataclasses.fields(Method):
        part = getattr(Method(), field.name)
        assert set(identity[field.name]) == {f.name for f in dataclasses.fields(part)}


@pytest.fixture(scope="module")
def prepared(write_site: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[SiteFile, Twin]:
    """Return the cluttered room."""
    path = write_site(tmp_path_factory.mktemp("room"))
    site = read_site(path)
    return site, prepare_twin(site, path.parent)


def test_another_number_is_another_part(prepared: tuple[SiteFile, Twin]) -> None:
    """Each field of all settings, changed by itself, gives the station's part another name."""
    site, twin = prepared
    names = {plan_build(site, twin)[0].part_id}
    count = 1
    for section in dataclasses.fields(Method):
        settings = getattr(Method(), section.name)
        if isinstance(settings, FixedNumbers):
            continue
        for field in dataclasses.fields(settings):
            value = getattr(settings, field.name)
            other = (*value, 99) if isinstance(value, tuple) else value * 2
            method = Method(**{section.name: dataclasses.replace(settings, **{field.name: other})})
            names.add(plan_build(site, twin, method)[0].part_id)
            count += 1
    assert count > 40
    assert len(names) == count


def test_the_identity_names_no_module() -> None:
    text = json.dumps(Method().identity())
    assert "rayfix" not in text
    assert not any(f"{module.__name__.rsplit('.', 1)[1]}." in text for _, module in modules())
