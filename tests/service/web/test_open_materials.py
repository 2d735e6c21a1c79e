"""The materials that the viewer draws paths through are those whose triangles the offline job lets rays through."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rayfix_offline.scene.scene import Scene
from rayfix_offline.scene.walls import opaque_walls, walls_of
from rayfix_offline.site import parse_site
from rayfix_service.web.viewer_settings import open_materials
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

NAMES = ("itu_glass", "mat-itu_concrete", "itu_metal", "pane", "Wood.001")
STATED = np.array([np.nan, 0.2, 0.01, np.nan, np.nan])
"""Thickness that the scene file states, m."""


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize(
    ("propagation", "materials"),
    [
        ({}, {}),
        ({"reflection": "itu"}, {}),
        ({"reflection": "itu"}, {"glass": {"thickness_m": 0.01}}),
        ({"reflection": "itu", "transmission": False}, {"glass": {"thickness_m": 0.01}}),
        ({"reflection": "itu"}, {"wood": {"thickness_m": 0.04}, "itu_metal": {"thickness_m": 0.001}}),
        ({}, {"pane": {"transmission_loss_db": 3.0}, "itu_metal": {"transmission_loss_db": 40.0}}),
        ({}, {"pane": {"itu": "plasterboard", "thickness_m": 0.02}, "wood": {"permittivity": 2.0}}),
        ({}, {"pane": {"itu": "metal", "thickness_m": 0.02}, "itu_glass": {"reflection_loss_db": 5.0}}),
        ({"reflection": "itu"}, {"concrete": {"permittivity": 4.0}}),
    ],
)
def test_as_the_offline_job(
    table: Table, stated: bool, propagation: dict[str, Any], materials: dict[str, dict[str, Any]]
) -> None:
    station = {"id": "a", "position_m": [0.1, 0.1, 1.0]}
    site = parse_site(
        {
            "site": {"name": "one", "scene": "one.glb"},
            "propagation": propagation,
            "materials": materials,
            "stations": [station],
        }
    )
    thickness = STATED if stated else None
    count = len(NAMES)
    scene = Scene(
        vertices=np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0)]),
        faces=np.zeros((count, 3), np.int32) + np.arange(3, dtype=np.int32),
        face_materials=np.arange(count, dtype=np.int16),
        materials=NAMES,
        face_objects=np.zeros(count, np.int32),
        objects=("all",),
        face_thickness=thickness,
    )
    sheets = opaque_walls(count, loss_db=0.0)
    passable = walls_of(site, scene, sheets.solid, sheets.outward).passable
    stored = replace(
        table.scene,
        vertices=scene.vertices,
        faces=scene.faces,
        face_materials=scene.face_materials,
        materials=NAMES,
        face_thickness=thickness,
    )
    info = SiteInfo(
        name="",
        north=0.0,
        max_path_length=1.0,
        stations=(),
        document=site.model_dump(mode="json", exclude_none=True),
    )
    expected = [name for name, passes in zip(NAMES, passable, strict=True) if passes]
    assert open_materials(replace(table, site=info, scene=stored)) == expected


def test_tables_of_earlier_versions_have_opaque_walls(table: Table) -> None:
    assert open_materials(replace(table, site=replace(table.site, document={}))) == []


@pytest.fixture
def table(make_table: Any) -> Table:
    return make_table()  # type: ignore[no-any-return]
