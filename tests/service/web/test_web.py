"""What the viewer asks the service for: its files, the scene, the mixtures, simulated reports."""

import asyncio
import io
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from rayfix.example.drop import EXAMPLE_POSITION, example_paths
from rayfix_service.http.answering.table_cache import TableCache
from rayfix_service.locator import Locator
from rayfix_service.web import assets, routes_assets
from rayfix_service.web.documents import MixtureDocument, mixture_document
from rayfix_service.web.glb import NO_MATERIAL, write_glb
from rayfix_service.web.inspector import mass_by_reflections, view_direction
from rayfix_service.web.simulation import find_path, simulate
from rayfix_service.wire import FixDocument, parse_report
from rayfix_tables.errors import ReportError
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.mixture import TubeMixture
from rayfix_tables.scene import Scene
from rayfix_tables.table import Table
from tests.support.running.running_app import RunningApp

DEGREE = math.pi / 180.0


@pytest.fixture(scope="module")
def table(hall_table_path: Path) -> Table:
    return Table.open(hall_table_path)


@pytest.fixture(scope="module")
def web(hall_table_path: Path) -> Iterator[RunningApp]:
    with RunningApp(hall_table_path, simulation=True) as web:
        yield web


# --- the scene ---------------------------------------------------------------------------------------------


def read_glb(body: bytes) -> trimesh.Scene:
    scene = trimesh.load(io.BytesIO(body), file_type="glb", process=False)
    assert isinstance(scene, trimesh.Scene)
    return scene


def two_triangles(offset: float) -> Scene:
    """Two triangles, one of concrete and one of no material, ``offset`` m from the origin."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 5]], dtype=np.float64) + offset
    return Scene(
        vertices=vertices,
        faces=np.array([[0, 1, 2], [0, 3, 1]], dtype=np.int32),
        face_materials=np.array([0, -1], dtype=np.int16),
        materials=("itu_concrete",),
        free_space=FreeSpace(origin=np.zeros(3), voxel_size=1.0, free=np.ones((1, 1, 1), dtype=np.bool_)),
        sha256="",
    )


@pytest.mark.parametrize("offset", [0.0, 500_000.0])
def test_another_library_reads_the_scene_upright_and_to_the_millimetre(offset: float):
    scene = two_triangles(offset)
    read = read_glb(write_glb(scene, "site"))
    names = sorted(part.visual.material.name for part in read.geometry.values())
    assert names == ["itu_concrete", NO_MATERIAL]
    world = read.to_geometry()
    # glTF is y-up: (x, y, z) of the scene frame is (x, z, -y) there.
    found = np.asarray(world.triangles)
    expected = scene.vertices[scene.faces][:, :, [0, 2, 1]] * [1, 1, -1]
    order = np.argsort(expected[:, :, 1].max(axis=1))
    np.testing.assert_allclose(found[np.argsort(found[:, :, 1].max(axis=1))], expected[order], atol=1e-3)


def test_the_scene_is_given_once(web: RunningApp, table: Table):
    response = web.get("/v1/scene.glb")
    assert response.headers["content-type"] == "model/gltf-binary"
    area = read_glb(response.content).area
    corners = table.scene.vertices[table.scene.faces]
    spin = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert area == pytest.approx(0.5 * np.linalg.norm(spin, axis=1).sum(), rel=1e-5)
    again = web.get("/v1/scene.glb", headers={"If-None-Match": response.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


# --- the inspector -----------------------------------------------------------------------------------------


def test_the_mixture_of_a_direction_is_what_the_fusion_uses(web: RunningApp, table: Table):
    """An angle alone gives a posterior that is the mixture, before it is cut to the free space."""
    direction = {"azimuth_deg": 60.0, "zenith_deg": 97.0}
    angle = {"station_id": "bs1", **direction}
    document = web.get("/v1/stations/bs1/mixture", params={**direction, "stdev_deg": 1.0, "limit": 512}).json()
    probability = np.array([c["probability"] for c in document["components"]])
    assert probability.sum() == pytest.approx(1.0, abs=1e-6)
    assert np.all(np.diff(probability) <= 0.0)
    assert sum(document["by_reflections"]) == pytest.approx(1.0)
    assert document["by_walls"] == pytest.approx([1.0])  # nothing lets signals through here
    assert {c["num_walls"] for c in document["components"]} == {0}
    assert document["num_components"] == sum(c["num_components"] for c in document["cells"])
    means = np.array([[c["position"][axis] for axis in "xyz"] for c in document["components"]])
    report = {"measurements": [{"type": "aoa", "azimuth_stdev_deg": 1.0, "zenith_stdev_deg": 1.0, **angle}]}
    posterior = Locator(table).posterior(parse_report(report))
    mean = np.exp(posterior.log_weight) @ posterior.mean / np.exp(posterior.log_weight).sum()
    np.testing.assert_allclose(probability @ means, mean, atol=0.05)


def test_the_level_follows_the_deviation(table: Table):
    part = table.parts["bs1"]
    windows = [
        view_direction(part, 1.0, 1.7, s * DEGREE, limit=8, origin=table.scene.origin).window for s in (0.5, 1.9, 7.9)
    ]
    np.testing.assert_allclose(windows, np.deg2rad([2.5, 2.5, 10.0]))
    assert len(view_direction(part, 1.0, 1.7, 30.0 * DEGREE, limit=8, origin=table.scene.origin).cells) > 1


def test_a_direction_without_rays_is_empty(table: Table):
    level = table.parts["bs1"].levels[0].expanded
    bare = replace(
        level,
        cell_offsets=np.zeros_like(level.cell_offsets),
        cell_log_mass=np.full(level.num_cells, -np.inf),
        mixture=TubeMixture.empty(),
    )
    view = view_direction(
        replace(table.parts["bs1"], levels=(bare,)), 1.0, 1.7, DEGREE, limit=8, origin=table.scene.origin
    )
    document = mixture_document("bs1", view)
    MixtureDocument.model_validate(document)
    assert document["components"] == []
    assert document["log_evidence"] is None
    assert mass_by_reflections(bare).tolist() == [0.0]


def test_the_mass_by_reflections_is_that_of_the_cells(table: Table):
    level = table.parts["bs2"].levels[1]
    expected = np.zeros(8)
    for cell in range(level.num_cells):
        mixture = level.cell(cell)
        for weight, reflections in zip(mixture.log_weight, mixture.num_reflections, strict=True):
            expected[reflections] += math.exp(level.cell_log_mass[cell] + weight)
    found = mass_by_reflections(level)
    np.testing.assert_allclose(found, (expected / expected.sum())[: len(found)], rtol=1e-9)


def test_coverage_and_refusals(web: RunningApp, table: Table):
    document = web.get("/v1/stations/bs3/coverage").json()
    assert document["coverage"] == list(table.parts["bs3"].coverage)
    assert document["wall_coverage"] == []
    assert [level["window_deg"] for level in document["levels"]] == [2.5, 10.0]
    unknown = web.get("/v1/stations/nowhere/coverage")
    assert unknown.status_code == 404
    assert "bs1, bs2, bs3, bs4" in unknown.json()["detail"]
    wrong = web.get("/v1/stations/bs1/mixture?azimuth_deg=nan&zenith_deg=200")
    assert wrong.status_code == 422
    assert [error["path"] for error in wrong.json()["errors"]] == ["azimuth_deg", "zenith_deg"]


# --- simulation --------------------------------------------------------------------------------------------


def test_a_simulated_path_is_one_of_the_forward_solvers(table: Table):
    """The table's path has the direction and the length of a path by the image method, which shares no code with it."""
    for station_id, exact in example_paths().items():
        path = find_path(table.parts[station_id], np.array(EXAMPLE_POSITION))
        assert path is not None
        apart = np.hypot(
            np.rad2deg(np.remainder(exact.azimuth - path.azimuth + np.pi, 2 * np.pi) - np.pi) * np.sin(path.zenith),
            np.rad2deg(exact.zenith - path.zenith),
        )
        off = np.abs(exact.path_length - path.path_length)
        assert np.any((apart < 0.5) & (off < 0.1) & (exact.num_reflections == path.num_reflections)), station_id


def test_a_simulated_path_is_of_no_component_without_a_covariance(table: Table):
    part = table.parts["bs1"]
    (finest, *others), place = part.levels, np.array(EXAMPLE_POSITION)
    finest = finest.expanded
    whole = find_path(part, place)
    assert whole is not None
    broken = finest.mixture.x_cov.copy()
    jacobian = finest.mixture.jacobian.copy()
    broken[::2], jacobian[::2] = 0.0, 0.0
    mixture = replace(finest.mixture, x_cov=broken, jacobian=jacobian)
    found = find_path(replace(part, levels=(replace(finest, mixture=mixture), *others)), place)
    assert found is not None
    assert whole.dropped == 0
    assert 0 < found.dropped < len(mixture)
    mixture = replace(mixture, x_cov=np.zeros_like(broken), jacobian=np.zeros_like(jacobian))
    assert find_path(replace(part, levels=(replace(finest, mixture=mixture), *others)), place) is None


def test_a_simulation_is_located_where_it_was(web: RunningApp):
    wanted = {"position": list(EXAMPLE_POSITION), "angle_stdev_deg": 0.25, "range_stdev_m": 0.1, "seed": 3}
    document = web.post("/v1/simulations", wanted).json()
    FixDocument.model_validate(document["fix"])
    position = np.array([document["fix"]["position"][axis] for axis in "xyz"])
    assert np.linalg.norm(position - EXAMPLE_POSITION) < 0.3
    assert {m["type"] for m in document["report"]["measurements"]} == {"aoa", "pt"}
    located = web.post("/v1/positions", document["report"]).json()
    assert located["position"] == document["fix"]["position"]


def test_the_noise_is_as_asked_for(table: Table):
    """Over many seeds, angles and lengths scatter about the noise-free path with the deviations that were given."""
    errors = []
    for seed in range(200):
        paths, measurements = simulate(
            table,
            EXAMPLE_POSITION,
            kinds=["aoa", "pt"],
            angle_stdev=DEGREE,
            range_stdev=0.5,
            rng=np.random.default_rng(seed),
        )
        angle = next(m for m in measurements if m["type"] == "aoa" and m["station_id"] == "bs1")
        length = next(m for m in measurements if m["type"] == "pt" and m["station_id"] == "bs1")
        path = next(p for p in paths if p.station_id == "bs1")
        errors.append(
            [
                angle["azimuth_deg"] - math.degrees(path.azimuth),
                angle["zenith_deg"] - math.degrees(path.zenith),
                length["range_m"] - path.path_length,
            ]
        )
    spread = np.std(errors, axis=0) / [1.0, 1.0, 0.5]
    np.testing.assert_allclose(spread, 1.0, atol=4 / math.sqrt(2 * 200))


def test_arrivals_share_a_clock_and_differences_a_reference(table: Table):
    def of(kinds: list[Any]) -> list[dict[str, Any]]:
        rng = np.random.default_rng(5)
        return simulate(table, EXAMPLE_POSITION, kinds=kinds, angle_stdev=DEGREE, range_stdev=0.5, rng=rng)[1]

    ranges = {m["station_id"]: m["range_m"] for m in of(["pt"])}
    arrivals = {m["station_id"]: m["range_m"] for m in of(["toa"])}
    offsets = np.array([arrivals[name] - ranges[name] for name in ranges])
    np.testing.assert_allclose(offsets, offsets[0], atol=1e-3)
    for difference in of(["tdoa"]):
        expected = ranges[difference["station_id"]] - ranges[difference["reference_station_id"]]
        assert difference["range_difference_m"] == pytest.approx(expected, abs=1e-3)


def test_places_without_signal_are_refused(web: RunningApp, table: Table):
    with pytest.raises(ReportError, match="in a solid or outdoors"):
        simulate(table, (-5, 0, 1), kinds=["aoa"], angle_stdev=1, range_stdev=1, rng=np.random.default_rng(1))
    response = web.post("/v1/simulations", {"position": [1, 2], "kinds": ["tod"], "seeds": 1})
    assert response.status_code == 422
    assert {error["path"] for error in response.json()["errors"]} == {"position", "kinds[0]", "seeds"}


def test_a_service_may_refuse_to_simulate(hall_table_path: Path):
    with RunningApp(hall_table_path, simulation=False) as web:
        assert web.get("/v1/viewer").json() == {"simulation": False, "max_reflections": 2, "open_materials": []}
        response = web.post("/v1/simulations", {"position": [1, 2, 1]})
    assert response.status_code == 403
    assert "--allow-simulation" in response.json()["detail"]


def test_the_posterior_of_a_report(web: RunningApp, table: Table):
    measurements = simulate(
        table, EXAMPLE_POSITION, kinds=["aoa"], angle_stdev=DEGREE, range_stdev=1, rng=np.random.default_rng(1)
    )[1]
    document = web.post("/v1/posteriors", {"measurements": measurements}).json()
    samples = np.array(document["samples"])
    assert np.all(table.scene.free_space.contains(samples))
    fix = Locator(table).locate(parse_report({"measurements": measurements}))
    mean = sum(c.probability * c.position for c in fix.candidates)
    np.testing.assert_allclose(samples.mean(axis=0), mean, atol=0.15)


# --- files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("address", "folder"), [("/", "assets"), ("/docs", "interface")])
def test_a_page_and_its_files_are_strict_and_cached(web: RunningApp, address: str, folder: str):
    if not assets.load_assets():
        pytest.skip("the viewer is not built; run make viewer")
    page = web.get(address)
    assert page.headers["content-type"].startswith("text/html")
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
    assert "unsafe" not in policy
    assert page.headers["cache-control"] == "no-cache"
    again = web.get(address, headers={"If-None-Match": page.headers["etag"]})
    assert again.status_code == 304
    script = next(line.split('"')[-2] for line in page.text.splitlines() if "<script" in line)
    assert script.startswith(f"./{folder}/")
    response = web.get(script.removeprefix("."))
    assert response.headers["cache-control"] == "public, max-age=31536000, immutable"
    assert response.headers["content-encoding"] == "gzip"
    assert web.get(f"/{folder}/../index.html").status_code == 404
    assert web.get(f"/{folder}/nothing.js").status_code == 404


def test_without_built_files_the_interface_is_a_plain_page(web: RunningApp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(routes_assets, "_assets", dict)
    viewer, interface = web.get("/"), web.get("/docs")
    assert "has no viewer" in viewer.text
    assert "POST /v1/positions" in interface.text
    for page in (viewer, interface):
        assert page.headers["content-security-policy"].startswith("default-src 'none'")


def test_the_built_files_are_below_a_megabyte():
    files = assets.load_assets()
    if not files:
        pytest.skip("the viewer is not built; run make viewer")
    assert sum(len(file.compressed or file.body) for file in files.values()) < 1_000_000
    assert not [name for name, file in files.items() if b"https://" in file.body and name.endswith((".html", ".css"))]


def test_without_built_files_there_are_no_assets(tmp_path: Path):
    assert assets.load_assets(tmp_path) == {}
    (tmp_path / "assets").mkdir()
    (tmp_path / "index.html").write_text("<p>", encoding="utf-8")
    (tmp_path / "assets" / "a-1.js").write_text("1;", encoding="utf-8")
    found = assets.load_assets(tmp_path)
    assert found["assets/a-1.js"].media_type == "text/javascript"
    assert found["index.html"].cache_control == "no-cache"


def test_results_of_tables_are_computed_once():
    async def ask() -> list[int]:
        kept, calls = TableCache(most=2), []
        for name in ("a", "a", "b", "c", "a"):
            await kept.get("table", name, lambda name=name: calls.append(name))
        return [calls.count(name) for name in "abc"]

    assert asyncio.run(ask()) == [2, 1, 1]  # "a" was the oldest when "c" came


def test_requests_at_the_same_time_wait_for_one_result():
    async def ask() -> tuple[list[object], list[str]]:
        kept, calls, may_end = TableCache(), list[str](), asyncio.Event()

        async def run(compute: Callable[[], str]) -> str:
            calls.append("a")
            await may_end.wait()
            return compute()

        tasks = [asyncio.create_task(kept.get("table", "a", lambda: "result", run)) for _ in range(4)]
        await asyncio.sleep(0)
        tasks[0].cancel()  # the client that came first is gone; the others get their result
        await asyncio.sleep(0)
        may_end.set()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        assert await kept.get("table", "a", lambda: "another", run) == "result"
        return results, calls

    (gone, *results), calls = asyncio.run(ask())
    assert isinstance(gone, asyncio.CancelledError)
    assert results == ["result"] * 3
    assert calls == ["a"]


def test_a_failed_result_is_computed_anew():
    async def ask() -> tuple[list[object], str]:
        kept, failures = TableCache(), [ValueError("once")]

        async def run(compute: Callable[[], str]) -> str:
            await asyncio.sleep(0)
            if failures:
                raise failures.pop()
            return compute()

        both = [kept.get("table", "a", lambda: "result", run) for _ in range(2)]
        failed = await asyncio.gather(*both, return_exceptions=True)
        return failed, await kept.get("table", "a", lambda: "result", run)

    failed, result = asyncio.run(ask())
    assert [str(error) for error in failed] == ["once", "once"]
    assert result == "result"
