"""Sites that are built in seconds."""

from pathlib import Path

from tests.support.scenes.rooms import room_with_crate
from tests.support.scenes.sites import stations_text

SITE = """\
[site]
name = "room"
scene = "room.ply"
[propagation]
max_reflections = 1
max_path_length_m = 20.0
[table]
windows_deg = [6.0, 15.0]
seed = {seed}
"""


def write_site(folder: Path, stations: dict[str, tuple[float, float]], *, seed: int = 1, box: float = 1.0) -> Path:
    """Write a room of 4 x 5 x 3 m with a box of 1 x 1 m in it, ``box`` m high, and its site file."""
    folder.mkdir(exist_ok=True)
    room_with_crate(box).export(folder / "room.ply")
    text = SITE.format(seed=seed) + stations_text({name: (x, y, 2.5) for name, (x, y) in stations.items()})
    (folder / "site.toml").write_text(text, encoding="utf-8")
    return folder / "site.toml"
