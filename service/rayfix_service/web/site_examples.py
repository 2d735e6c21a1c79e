"""Examples in the OpenAPI document that the served table can answer without changes."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from rayfix_service.measuring.ranging import SPEED_OF_LIGHT
from rayfix_service.web.simulation import SimulatedPath, simulate
from rayfix_tables.errors import ReportError
from rayfix_tables.geometry.angles import angles_of, direction, local_to_scene
from rayfix_tables.table import Table

_TRIES = 64
_MOST_STATIONS = 3
_SEED = 7
_OF_THE_HALL = frozenset({"bs1", "bs2", "bs3"})

_TIMING = {"timingMeasQuality": {"measurementQuality": 5, "resolution": "m0dot1"}}
_TC_METRES = SPEED_OF_LIGHT / (480e3 * 4096)


def with_site_examples(document: Mapping[str, Any], table: Table) -> dict[str, Any]:
    """Replace the examples of an OpenAPI document by examples with a table's stations.

    For the bundled hall, the document is unchanged. Examples that need more stations than the table has are removed.
    All are removed if none of the sampled positions is audible to a station.

    Parameters
    ----------
    document : Mapping
        The OpenAPI document of the service.
    table : Table
    """
    if table.site.name == "hall" and table.parts.keys() >= _OF_THE_HALL:
        return dict(document)
    place, paths = _audible_position(table)
    changed = copy.deepcopy(dict(document))
    examples = _examples(table, paths) if paths else {}
    if paths:
        examples["/v1/simulations"] = {"somewhere": {"position": place, "kinds": ["aoa", "pt"], "seed": 1}}
        examples["/v1/posteriors"] = examples["/v1/positions"]
    for path, operations in changed["paths"].items():
        for operation in operations.values():
            for content in operation.get("requestBody", {}).get("content", {}).values():
                own = examples.get(path, {})
                content["examples"] = {
                    name: {"summary": name.replace("_", " ").capitalize(), "value": value}
                    for name, value in own.items()
                }
                if not own:
                    del content["examples"]
    return changed


def _audible_position(table: Table) -> tuple[list[float], list[SimulatedPath]]:
    """Find a position that is audible to many stations, and their paths to it, fewest reflections first."""
    space = table.scene.free_space
    voxels = np.argwhere(space.free)
    rng = np.random.default_rng(_SEED)
    best: tuple[list[float], list[SimulatedPath]] = ([], [])
    for voxel in voxels[rng.permutation(len(voxels))[:_TRIES]]:
        place = (space.origin + (voxel + 0.5) * space.voxel_size).round(3).tolist()
        try:
            paths, _ = simulate(table, place, kinds=("aoa",), angle_stdev=0.0, range_stdev=0.0, rng=rng)
        except ReportError:
            continue
        paths = sorted(paths, key=lambda path: path.num_reflections)[:_MOST_STATIONS]
        if (len(paths), -sum(p.num_reflections for p in paths)) > (
            len(best[1]),
            -sum(p.num_reflections for p in best[1]),
        ):
            best = (place, paths)
    return best


def _examples(table: Table, paths: list[SimulatedPath]) -> dict[str, dict[str, Any]]:
    """Request bodies by path and name; measurements have no error."""
    angles = [_angle(path) for path in paths]
    ranges = [
        {"type": "pt", "station_id": path.station_id, "range_m": round(path.path_length, 2), "stdev_m": 0.5}
        for path in paths
    ]
    reports: dict[str, Any] = {
        "angle_and_time": {
            "target_id": "agv-7",
            "timestamp": "2026-01-31T10:00:00.250Z",
            "measurements": [angles[0], ranges[0]],
        },
        "angles_and_times": {"target_id": "agv-7", "measurements": [*angles, *ranges]},
    }
    if len(paths) > 1:
        reports["angles"] = {"target_id": "agv-7", "measurements": angles}
        reports["time_differences"] = {"measurements": [*angles, *_differences(paths)]}
    messages = {"nrppa": _nrppa(table, paths), "silabs": _silabs(table, paths)}
    found: dict[str, dict[str, Any]] = {
        "/v1/positions": reports,
        "/v1/positions/batch": {"two_reports": {"reports": [reports["angle_and_time"], reports["angles_and_times"]]}},
    }
    for name, message in messages.items():
        found[f"/v1/positions/{name}"] = {"a_message": message}
        found[f"/v1/positions/{name}/batch"] = {"one_message": {"reports": [message]}}
    lines = _lines(table, paths)
    return found | ({"/v1/positions/ublox": {"lines": lines}} if lines else {})


def _angle(path: SimulatedPath) -> dict[str, Any]:
    return {
        "type": "aoa",
        "station_id": path.station_id,
        "azimuth_deg": round(float(np.rad2deg(path.azimuth)), 1),
        "zenith_deg": round(float(np.rad2deg(path.zenith)), 1),
        "azimuth_stdev_deg": 1.0,
        "zenith_stdev_deg": 1.0,
    }


def _differences(paths: list[SimulatedPath]) -> list[dict[str, Any]]:
    return [
        {
            "type": "tdoa",
            "station_id": path.station_id,
            "reference_station_id": paths[0].station_id,
            "range_difference_m": round(path.path_length - paths[0].path_length, 2),
            "stdev_m": 0.7,
        }
        for path in paths[1:]
    ]


def _nrppa(table: Table, paths: list[SimulatedPath]) -> dict[str, Any]:
    """UL-AoA from geographic north, and UL-RTOA if two TRPs share the unknown clock."""
    items = []
    for n, path in enumerate(paths, start=1):
        azimuth = int(np.rad2deg(path.azimuth - table.site.north) * 10.0) % 3600
        zenith = min(int(np.rad2deg(path.zenith) * 10.0), 1799)
        results: list[dict[str, Any]] = [
            {
                "measuredResultsValue": {"uL-AngleOfArrival": {"azimuthAoA": azimuth, "zenithAoA": zenith}},
                "measurementQuality": {
                    "angleMeasQuality": {"azimuthQuality": 10, "zenithQuality": 10, "resolution": "deg0dot1"}
                },
            }
        ]
        if len(paths) > 1:
            steps = 985024 // 2 + round(path.path_length / (2.0 * _TC_METRES))
            results.append(
                {
                    "measuredResultsValue": {"uL-RTOA": {"uLRTOAmeas": {"k1": steps}}},
                    "measurementQuality": _TIMING,
                }
            )
        items.append({"tRP-ID": n, "measurementResult": results})
    names = {str(n): path.station_id for n, path in enumerate(paths, start=1)}
    return {"target_id": "ue-7", "stations": names, "TRP-MeasurementResponseList": items}


def _local(table: Table, path: SimulatedPath) -> tuple[float, float]:
    """Azimuth and elevation of a path in its station's local frame, deg."""
    turn = local_to_scene(table.parts[path.station_id].station.orientation)
    azimuth, zenith = angles_of(direction(path.azimuth, path.zenith) @ turn)
    return float(np.rad2deg(azimuth)), 90.0 - float(np.rad2deg(zenith))


def _silabs(table: Table, paths: list[SimulatedPath]) -> dict[str, Any]:
    angles = []
    for path in paths:
        azimuth, elevation = _local(table, path)
        angles.append(
            {
                "locator_id": path.station_id,
                "azimuth": round(-azimuth, 1),
                "azimuth_stdev": 1.2,
                "elevation": round(elevation, 1),
                "elevation_stdev": 1.1,
                "sequence": 4711,
            }
        )
    return {"target_id": "ble-pd-60A423C96B9A", "angles": angles}


def _lines(table: Table, paths: list[SimulatedPath]) -> str:
    """Lines of the stations with the target in front of them."""
    lines = []
    for path in paths:
        azimuth, elevation = _local(table, path)
        if abs(azimuth) <= 90.0:
            lines.append(f'+UUDF:6C1DEBA5F60C,-53,{-azimuth:.0f},{elevation:.0f},0,37,"{path.station_id}","",0,40871\n')
    return "".join(lines)
