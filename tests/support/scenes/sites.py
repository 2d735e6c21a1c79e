"""Site files."""

from collections.abc import Mapping, Sequence


def stations_text(positions: Mapping[str, Sequence[float]]) -> str:
    """Write the sections of stations by their names and positions, m."""
    return "".join(f'[[stations]]\nid = "{name}"\nposition_m = {list(p)}\n' for name, p in positions.items())
