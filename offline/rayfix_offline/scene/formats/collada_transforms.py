"""Transforms of COLLADA's nodes."""

from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.formats.xml_limits import kind_of

SIZES = {"matrix": 16, "translate": 3, "scale": 3, "rotate": 4, "lookat": 9, "skew": 7}


def transform_of(node: Element) -> NDArray[np.float64]:
    """Return the transform of a node, shape (4, 4): its elements, the last of which is applied first.

    Raises
    ------
    ValueError
        When an element has a wrong number of values.
    """
    out = np.eye(4)
    for element in node:
        kind = kind_of(element)
        if kind in SIZES:
            try:
                numbers = np.array((element.text or "").split(), np.float64)
            except ValueError:
                numbers = np.zeros(0)
            if len(numbers) != SIZES[kind]:
                raise ValueError(f"a <{kind}> without exactly {SIZES[kind]} numbers")
            out = out @ _matrix(kind, numbers)
    return out


def rotation(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Return the rotation about an axis by an angle in radians, shape (4, 4) (Rodrigues' formula)."""
    out = np.eye(4)
    length = float(np.linalg.norm(axis))
    if length > 0.0:
        x, y, z = axis / length
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        out[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return out


def _matrix(kind: str, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.eye(4)
    if kind == "matrix":
        return numbers.reshape(4, 4)
    if kind == "translate":
        out[:3, 3] = numbers
    elif kind == "scale":
        out[:3, :3] = np.diag(numbers)
    elif kind == "rotate":
        return rotation(numbers[:3], float(np.deg2rad(numbers[3])))
    elif kind == "lookat":
        eye, interest, up = numbers.reshape(3, 3)
        back = (eye - interest) / (np.linalg.norm(eye - interest) or 1.0)
        right = np.cross(up, back)
        right /= np.linalg.norm(right) or 1.0
        out[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        out[:3, 3] = eye
    else:
        raise ValueError("a <skew>, which is not supported")
    return out
