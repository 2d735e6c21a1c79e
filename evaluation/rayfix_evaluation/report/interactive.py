"""Interactive 3D pictures, by Plotly."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from rayfix_evaluation.report.geometry import Backdrop, ellipsoids, unit_sphere
from rayfix_evaluation.report.spaces import ESTIMATE, FIX, TRUTH
from rayfix_evaluation.report.style import STATIONS

__all__ = ["plotly_script", "space_figure"]

Array = NDArray[np.float64]
Pictures = Mapping[str, Any]

_SOLID = "#9aa3af"


def plotly_script() -> str:
    """Source code of Plotly's library, to be included once in a page."""
    return str(get_plotlyjs())


def space_figure(scene: Backdrop, pictures: Pictures, show: str) -> str:
    """JSON of a Plotly figure with the same content as :func:`rayfix_evaluation.report.spaces.space_picture`."""
    traces: list[Any] = [_solids(scene), _box(scene)]
    for n, station in enumerate(pictures["stations"]):
        colour, name = STATIONS[n % len(STATIONS)], station["id"]
        traces.append(_marker(scene.stations[name], name, colour, "diamond"))
        if show == "scene":
            path = np.round(np.array(station["path"]), 3)
            traces.append(
                go.Scatter3d(
                    **_xyz(path),
                    mode="lines",
                    line={"color": colour, "width": 4},
                    name=f"path to {name}, {station['bounces']} reflections, {station['walls']} walls",
                )
            )
            if station["walls"]:
                dots = np.array(station["crossings"])
                marker = {"color": colour, "size": 4, "symbol": "square-open"}
                traces.append(go.Scatter3d(**_xyz(dots), mode="markers", marker=marker, name="walls", showlegend=False))
        elif show.startswith("points"):
            points = np.array(station[show]).reshape(-1, 3)
            marker = {"color": colour, "size": 2, "opacity": 0.7}
            traces.append(go.Scatter3d(**_xyz(points), mode="markers", marker=marker, name=f"points of {name}"))
        else:
            traces.extend(_ellipsoids(station[show], colour, f"mixture of {name}"))
    estimate = pictures["estimates"]["pt" if show.endswith("pt") else "aoa"]
    if show.startswith("mixture") and estimate is not None:
        traces.append(_marker(estimate, "arg max of the product", ESTIMATE, "x"))
    if show == "mixture_pt" and pictures["rayfix"] is not None:
        traces.append(_marker(pictures["rayfix"], "rayfix", FIX, "circle"))
    traces.append(_marker(pictures["truth"], "true position", TRUTH, "cross"))
    hidden = {"visible": False}
    layout = {
        "scene": {"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, "aspectmode": "data", "camera": _camera(scene)},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "height": 470,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": _SOLID},
        "legend": {"orientation": "h", "y": 0, "yanchor": "top"},
        "showlegend": True,
    }
    # Plain arrays instead of Plotly's base64 of float64: smaller for rounded numbers.
    figure = go.Figure(traces, layout)
    return json.dumps({"data": _plain(figure.to_dict()["data"]), "layout": layout}, separators=(",", ":"))


def _camera(scene: Backdrop) -> dict[str, Any]:
    extent = scene.high - scene.low
    eye = {"x": 1.7, "y": -0.4, "z": 1.1} if extent[1] > extent[0] else {"x": -0.4, "y": -1.7, "z": 1.1}
    return {"eye": eye, "center": {"x": 0, "y": 0, "z": -0.1}}


def _solids(scene: Backdrop) -> Any:
    vertices, corner = np.unique(np.round(scene.triangles.reshape(-1, 3), 3), axis=0, return_inverse=True)
    faces = corner.reshape(-1, 3)
    return go.Mesh3d(
        **_xyz(vertices),
        i=faces[:, 0].tolist(),
        j=faces[:, 1].tolist(),
        k=faces[:, 2].tolist(),
        color=_SOLID,
        opacity=0.28,
        flatshading=True,
        hoverinfo="skip",
        name="objects",
    )


def _box(scene: Backdrop) -> Any:
    # None separates the line segments of edges.
    corners = np.round(scene.box_edges(), 3).tolist()
    x, y, z = ([value for edge in corners for value in (edge[0][axis], edge[1][axis], None)] for axis in range(3))
    line = {"color": _SOLID, "width": 2}
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line=line, hoverinfo="skip", showlegend=False)


def _marker(point: Any, name: str, colour: str, symbol: str) -> Any:
    x, y, z = (round(float(v), 3) for v in point)
    marker = {"color": colour, "size": 6, "symbol": symbol}
    return go.Scatter3d(x=[x], y=[y], z=[z], mode="markers", marker=marker, name=name)


def _ellipsoids(mixture: Any, colour: str, name: str) -> list[Any]:
    sphere, faces = unit_sphere()
    found = list(ellipsoids(mixture))
    heaviest = max((weight for weight, _, _ in found), default=1.0)
    return [
        go.Mesh3d(
            **_xyz(np.round(centre + sphere @ root.T, 3)),
            i=faces[:, 0].tolist(),
            j=faces[:, 1].tolist(),
            k=faces[:, 2].tolist(),
            color=colour,
            opacity=round(0.12 + 0.4 * weight / heaviest, 3),
            name=name,
            legendgroup=name,
            showlegend=n == 0,
            hovertemplate=f"{name}, weight {weight:.2f}<extra></extra>",
        )
        for n, (weight, centre, root) in enumerate(found)
    ]


def _xyz(points: Array) -> dict[str, list[float]]:
    return {axis: points[:, n].tolist() for n, axis in enumerate("xyz")}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray) else value
