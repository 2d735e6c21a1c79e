"""IFC models that the tests write themselves through ifcopenshell; without the extra, one clear message."""

import importlib.util
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from rayfix_offline.scene.scene import Scene, load_scene
from rayfix_offline.site import parse_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.errors import SceneError

needs_ifc = pytest.mark.skipif(
    importlib.util.find_spec("ifcopenshell") is None, reason="ifcopenshell is not installed: pip install 'rayfix[ifc]'"
)

WALL = 0.2
"""Thickness of walls and slabs, m."""

BODIES: dict[str, tuple[str, tuple[float, ...], tuple[float, ...]]] = {
    "south": ("IfcWall", (0, -WALL, 0), (4, 0, 3)),
    "north": ("IfcWall", (0, 5, 0), (4, 5 + WALL, 3)),
    "west": ("IfcWall", (-WALL, -WALL, 0), (0, 5 + WALL, 3)),
    "east": ("IfcWall", (4, -WALL, 0), (4 + WALL, 5 + WALL, 3)),
    "floor": ("IfcSlab", (-WALL, -WALL, -WALL), (4 + WALL, 5 + WALL, 0)),
    "roof": ("IfcSlab", (-WALL, -WALL, 3), (4 + WALL, 5 + WALL, 3 + WALL)),
    "door": ("IfcDoor", (1, -0.1, 0), (2, -0.05, 2)),
    "cabinet": ("IfcFurniture", (2, 3, 0), (3, 4, 2)),
}
OPENING = ((1.0, -WALL, 0.0), (2.0, 0.0, 2.0))


class Model:
    """An IFC file in the making."""

    def __init__(self, schema: str, prefix: str | None) -> None:
        import ifcopenshell.api.context
        import ifcopenshell.api.owner
        import ifcopenshell.api.project
        import ifcopenshell.api.root
        import ifcopenshell.api.unit

        self.file = ifcopenshell.api.project.create_file(version=schema)
        if schema == "IFC2X3":  # which does not do without an author
            person = ifcopenshell.api.owner.add_person(self.file)
            organisation = ifcopenshell.api.owner.add_organisation(self.file)
            ifcopenshell.api.owner.add_person_and_organisation(self.file, person=person, organisation=organisation)
            ifcopenshell.api.owner.add_application(self.file)
        ifcopenshell.api.root.create_entity(self.file, ifc_class="IfcProject", name="room")
        length = ifcopenshell.api.unit.add_si_unit(self.file, unit_type="LENGTHUNIT", prefix=prefix)
        ifcopenshell.api.unit.assign_unit(self.file, units=[length])
        model = ifcopenshell.api.context.add_context(self.file, context_type="Model")
        self.body = ifcopenshell.api.context.add_context(
            self.file, context_type="Model", context_identifier="Body", target_view="MODEL_VIEW", parent=model
        )

    def box(self, ifc_class: str, name: str, low: ArrayLike, high: ArrayLike) -> Any:
        """Add a product that is an axis-aligned box, corners in metres."""
        import ifcopenshell.api.geometry
        import ifcopenshell.api.root

        product = ifcopenshell.api.root.create_entity(self.file, ifc_class=ifc_class, name=name)
        size = np.subtract(high, low)
        shape = ifcopenshell.api.geometry.add_wall_representation(
            self.file, context=self.body, length=size[0], thickness=size[1], height=size[2]
        )
        ifcopenshell.api.geometry.assign_representation(self.file, product=product, representation=shape)
        place = np.eye(4)
        place[:3, 3] = low
        ifcopenshell.api.geometry.edit_object_placement(self.file, product=product, matrix=place)
        return product

    def material(self, product: Any, name: str, category: str | None = None) -> None:
        """Give a product a material."""
        import ifcopenshell.api.material

        material = ifcopenshell.api.material.add_material(self.file, name=name, category=category)
        ifcopenshell.api.material.assign_material(self.file, products=[product], material=material)

    def style(self, product: Any, name: str) -> None:
        """Give a product's surface a style."""
        import ifcopenshell.api.style

        style = ifcopenshell.api.style.add_style(self.file, name=name)
        ifcopenshell.api.style.add_surface_style(
            self.file,
            style=style,
            ifc_class="IfcSurfaceStyleShading",
            attributes={"SurfaceColour": {"Name": None, "Red": 0.5, "Green": 0.5, "Blue": 0.5}},
        )
        shape = product.Representation.Representations[0]
        ifcopenshell.api.style.assign_representation_styles(self.file, shape_representation=shape, styles=[style])


def room(schema: str = "IFC4", prefix: str | None = "MILLI") -> tuple[Model, dict[str, Any]]:
    """Room of 4 x 5 x 3 m of walls and slabs, with a door in an opening and a cabinet; and a space that fills it."""
    import ifcopenshell.api.feature

    model = Model(schema, prefix)
    bodies = dict(BODIES)
    if schema == "IFC2X3":
        bodies["cabinet"] = ("IfcFurnishingElement", *bodies["cabinet"][1:])
    products = {name: model.box(kind, name, low, high) for name, (kind, low, high) in bodies.items()}
    opening = model.box("IfcOpeningElement", "opening", *OPENING)
    ifcopenshell.api.feature.add_feature(model.file, feature=opening, element=products["south"])
    model.box("IfcSpace", "space", (0, 0, 0), (4, 5, 3))
    return model, products


@pytest.fixture
def save(tmp_path: Path) -> Callable[[Model], Path]:
    """Return a function that writes a model."""

    def write(model: Model) -> Path:
        path = tmp_path / "room.ifc"
        model.file.write(str(path))
        return path

    return write


def named(scene: Scene, name: str) -> NDArray[np.bool_]:
    """Triangles of the product of a name."""
    (index,) = [n for n, found in enumerate(scene.objects) if found.startswith(f"{name} (")]
    return np.asarray(scene.face_objects == index)


@needs_ifc
@pytest.mark.parametrize("schema", ["IFC2X3", "IFC4", "IFC4X3"])
@pytest.mark.parametrize("prefix", ["MILLI", "CENTI", None])
def test_every_product_is_an_object_in_metres(save: Callable[[Model], Path], schema: str, prefix: str | None) -> None:
    model, products = room(schema, prefix)
    # What the site says counts for nothing: the file knows its unit, and z points up.
    scene = load_scene(save(model), unit="ft", up="y")
    assert sorted(scene.objects) == sorted(f"{name} ({p.GlobalId})" for name, p in products.items())
    for name, (_, low, high) in BODIES.items():
        corners = scene.triangles[named(scene, name)].reshape(-1, 3)
        np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [low, high], rtol=0, atol=1e-9)


@needs_ifc
def test_an_opening_is_cut_out_of_its_wall(save: Callable[[Model], Path]) -> None:
    scene = load_scene(save(room()[0]))
    a, b, c = (scene.triangles[named(scene, "south")][:, i] for i in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(4.0 * 3.0 * WALL - 1.0 * 2.0 * WALL, rel=1e-9)


@needs_ifc
def test_materials(save: Callable[[Model], Path]) -> None:
    """The style comes before the material, and that before its category; what P.2040 does not know keeps its name."""
    model, products = room()
    model.material(products["south"], "itu_brick")
    model.material(products["north"], "C30/37", category="concrete")
    model.material(products["west"], "S355", category="Steel")
    model.material(products["east"], "Unobtainium", category="plastic")
    model.material(products["door"], "Oak", category="wood")
    model.style(products["door"], "glass")
    model.style(products["floor"], "Grey")
    scene = load_scene(save(model))
    expected = {
        "south": "itu_brick",
        "north": "itu_concrete",
        "west": "itu_metal",
        "east": "Unobtainium",
        "door": "itu_glass",
        "floor": "Grey",
        "roof": None,
        "cabinet": None,
    }
    for name, material in expected.items():
        (index,) = set(scene.face_materials[named(scene, name)].tolist())
        assert (scene.materials[index] if index >= 0 else None) == material, name


@needs_ifc
def test_the_twin_of_a_room(save: Callable[[Model], Path]) -> None:
    """The station is in the room between solid walls; the free space is the room and the open part of the doorway."""
    path = save(room()[0])
    site = parse_site(
        {
            "site": {"name": "room", "scene": path.name},
            "stations": [{"id": "bs1", "position_m": [0.3, 0.3, 2.7]}],
        }
    )
    twin = prepare_twin(site, path.parent)
    assert twin.findings == ()
    inside = np.array([(2.0, 2.0, 1.0), (0.1, 4.9, 2.9)])
    assert twin.free_space.contains(inside).all()
    assert not twin.free_space.contains(np.array([(2.5, 3.5, 1.0), (-0.1, 2.0, 1.0), (2.0, 2.0, -0.1)])).any()
    assert twin.free_space.volume == pytest.approx(4 * 5 * 3 - 1 * 1 * 2, rel=0.02)


@needs_ifc
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.99])
def test_a_truncated_model(save: Callable[[Model], Path], share: float) -> None:
    path = save(room()[0])
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(SceneError, match="cannot be read as IFC"):
        load_scene(path)


@needs_ifc
def test_a_model_without_bodies(save: Callable[[Model], Path]) -> None:
    with pytest.raises(SceneError, match="holds no triangles"):
        load_scene(save(Model("IFC4", None)))


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "ifcopenshell"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    (tmp_path / "a.ifc").write_text("ISO-10303-21;", encoding="utf-8")
    with pytest.raises(SceneError, match=re.escape("install it with: pip install 'rayfix[ifc]'")):
        load_scene(tmp_path / "a.ifc")


@needs_ifc
def test_products_without_a_body_are_named(save: Callable[[Model], Path]) -> None:
    """A wall of no height, and an opening of no height, which leaves its wall whole."""
    model, products = room()
    path = save(model)
    guid = products["cabinet"].GlobalId
    text = path.read_text()
    solids = [products[name].Representation.Representations[0].Items[0] for name in ("cabinet",)]
    for solid in solids:
        text = re.sub(rf"(#{solid.id()}=IFCEXTRUDEDAREASOLID\([^)]*,)[^,)]*\)", r"\g<1>0.)", text)
    path.write_text(text)
    scene = load_scene(path)
    told = [remark.problem for remark in scene.remarks]
    assert told[0] == f"no body can be made of 1 product: cabinet ({guid})"
    assert "ifcopenshell reports" in told[1]
    assert len(scene.objects) == len(BODIES) - 1


@needs_ifc
def test_an_opening_that_cannot_be_cut_is_told_of(save: Callable[[Model], Path]) -> None:
    model, _ = room()
    (opening,) = model.file.by_type("IfcOpeningElement")
    solid = opening.Representation.Representations[0].Items[0]
    path = save(model)
    text = re.sub(rf"(#{solid.id()}=IFCEXTRUDEDAREASOLID\([^)]*,)[^,)]*\)", r"\g<1>0.)", path.read_text())
    path.write_text(text)
    told = [remark.problem for remark in load_scene(path).remarks]
    assert len(told) == 1
    assert "bodies or openings may be missing" in told[0]


@needs_ifc
@pytest.mark.parametrize(
    ("before", "behind"),
    [(b"\xef\xbb\xbf", b""), (b"", b"\n/* made by a program; */\n"), (b"", b"\x1a"), (b"", bytes(512))],
)
def test_what_stands_around_a_model(before: bytes, behind: bytes, save: Callable[[Model], Path]) -> None:
    path = save(room()[0])
    plain = load_scene(path)
    assert plain.remarks == ()
    path.write_bytes(before + path.read_bytes().rstrip() + behind)
    scene = load_scene(path)
    assert (scene.sha256, scene.remarks) == (plain.sha256, ())


@needs_ifc
def test_more_behind_the_end_mark_is_told_of(save: Callable[[Model], Path]) -> None:
    path = save(room()[0])
    path.write_bytes(path.read_bytes() + b"#9999=IFCWALL();\n")
    assert "after its end mark" in load_scene(path).remarks[0].problem


@needs_ifc
def test_the_plain_name_of_the_newest_schema(save: Callable[[Model], Path]) -> None:
    path = save(room("IFC4X3")[0])
    plain = load_scene(path)
    text, times = re.subn(r"'IFC4X3\w*'", "'IFC4X3'", path.read_text(), count=1)
    assert times == 1
    path.write_text(text)
    assert load_scene(path).sha256 == plain.sha256


def test_layers_state_the_thickness(save: Callable[[Model], Path]) -> None:
    """In the file's unit, whether the layers belong to the wall itself or to its type's usage."""
    import ifcopenshell.api.material

    model = Model("IFC4", "MILLI")
    plain, layered = (model.box("IfcWall", name, (0, 0, 0), (3, 0.125, 3)) for name in ("plain", "layered"))
    model.material(plain, "itu_brick")
    layers = ifcopenshell.api.material.add_material_set(model.file, name="lining", set_type="IfcMaterialLayerSet")
    for name, thickness in (("itu_plasterboard", 25.0), ("itu_wood", 75.0), ("itu_plasterboard", 25.0)):
        material = ifcopenshell.api.material.add_material(model.file, name=name)
        layer = ifcopenshell.api.material.add_layer(model.file, layer_set=layers, material=material)
        ifcopenshell.api.material.edit_layer(model.file, layer=layer, attributes={"LayerThickness": thickness})
    ifcopenshell.api.material.assign_material(
        model.file, products=[layered], type="IfcMaterialLayerSetUsage", material=layers
    )
    scene = load_scene(save(model))
    assert scene.face_thickness is not None
    for name, thickness in (("plain", np.nan), ("layered", 0.125)):
        found = {round(float(value), 9) for value in scene.face_thickness[named(scene, name)]}
        assert found == {thickness} or (np.isnan(thickness) and np.isnan(list(found)).all())
