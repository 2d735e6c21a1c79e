"""Messages of all formats, changed at random so that few of them are still valid."""

import copy
import json
from typing import Any

import numpy as np

from rayfix_service.http.openapi.examples import (
    BATCH_EXAMPLES,
    NRPPA_EXAMPLES,
    REPORT_EXAMPLES,
    SILABS_EXAMPLES,
    UBLOX_EXAMPLES,
)

_SOURCES: list[tuple[str, Any]] = [
    (path, example["value"])
    for path, examples in (
        ("/v1/positions", REPORT_EXAMPLES),
        ("/v1/positions/batch", BATCH_EXAMPLES),
        ("/v1/positions/nrppa", NRPPA_EXAMPLES),
        ("/v1/positions/silabs", SILABS_EXAMPLES),
        ("/v1/positions/ublox", UBLOX_EXAMPLES),
    )
    for example in examples.values()
]

_ODD: list[Any] = [
    None, True, -1, 0, 1e308, -1e308, 5e-324, float("nan"), float("inf"), 2**63, 10**400, "", "x" * 300, "\0", "\ud800",
    [], {}, [[]], [None] * 300, {"a": {"b": {}}}, "1", "NaN", "bs1", "<script>", 1e-9, 1e9,
]  # fmt: skip


def malformed(rng: np.random.Generator) -> tuple[str, bytes]:
    """Draw a path of the service and a body for it."""
    path, value = random_message(rng)
    if isinstance(value, str):
        return path, _garbled(value.encode(), rng)
    for _ in range(int(rng.integers(0, 4))):
        _change(value, rng)
    text = json.dumps(value).encode()
    return path, _garbled(text, rng) if rng.random() < 0.4 else text


def random_message(rng: np.random.Generator) -> tuple[str, Any]:
    """Draw a path of the service and a valid message for it: a document, or a text of lines."""
    path, value = _SOURCES[int(rng.integers(len(_SOURCES)))]
    return path, copy.deepcopy(value)


def changed_message(message: Any, rng: np.random.Generator) -> Any:
    """Change a message, as a rule so that it has more of something."""
    if isinstance(message, str):
        lines = message.splitlines() or [""]
        line = lines[int(rng.integers(len(lines)))]
        match int(rng.integers(3)):
            case 0:
                return "\n".join([*lines, *lines])
            case 1:
                return "\n".join([*lines, _garbled(line.encode(), rng).decode(errors="replace")])
            case _:
                return "\n".join(lines + [_numbered(line, n) for n in range(int(rng.integers(1, 500)))])
    changed = copy.deepcopy(message)
    for _ in range(int(rng.integers(1, 4))):
        _change(changed, rng)
    return changed


def _numbered(line: str, number: int) -> str:
    """Give a line another last field, as a packet has."""
    return f"{line.rpartition(',')[0]},{number}"


def _change(document: Any, rng: np.random.Generator) -> None:
    """Change one value at a random place, take it out, double it, or add one."""
    holder = document
    while True:
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        if not keys:
            return
        key = keys[int(rng.integers(len(keys)))]
        inner = holder[key]
        if not isinstance(inner, dict | list) or not inner or rng.random() < 0.25:
            break
        holder = inner
    odd = copy.deepcopy(_ODD[int(rng.integers(len(_ODD)))])
    match int(rng.integers(4)):
        case 0 | 1:
            holder[key] = odd
        case 2:
            del holder[key]
        case _ if isinstance(holder, list):
            holder.extend(copy.deepcopy([inner] * int(rng.integers(1, 300))))
        case _:
            holder[f"k{int(rng.integers(1000))}"] = odd


def _garbled(text: bytes, rng: np.random.Generator) -> bytes:
    """Flip, cut, repeat or insert bytes."""
    content = bytearray(text)
    for _ in range(int(rng.integers(1, 6))):
        if not content:
            break
        place, length = int(rng.integers(len(content))), int(rng.integers(1, 20))
        match int(rng.integers(5)):
            case 0:
                content[place] ^= 1 << int(rng.integers(8))
            case 1:
                del content[place : place + length]
            case 2:
                content[place:place] = content[place : place + length] * int(rng.integers(1, 50))
            case 3:
                content[place:place] = rng.bytes(length)
            case _:
                del content[place:]
    return bytes(content)
