"""Files that a scene names: only those in its folder are read."""

from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from trimesh.resolvers import Resolver

from rayfix_tables.errors import SceneError


def inside(folder: Path, base: Path, name: str) -> Path | None:
    """Return the path of a file that a scene names, None where that leaves the scene's folder.

    Parameters
    ----------
    folder : Path
        The scene's.
    base : Path
        That of the file which names it, in ``folder``.
    name : str
        Relative to ``base``. Links count as where they lead.
    """
    try:
        path = (base / name).resolve()
    except (OSError, RuntimeError, ValueError):  # a name that is too long, a circle of links, a zero byte
        return base / "no such file"
    return path if path.is_relative_to(folder.resolve()) else None


def outside_error(where: str, name: str) -> SceneError:
    """Return what to raise when a scene names a file elsewhere."""
    return SceneError(
        f"{where} names the file '{name[:200]}', which is not in the scene's folder; put it there and name it relative "
        "to the file that needs it"
    )


class SceneFolder(Resolver):  # type: ignore[misc]
    """Gives trimesh's readers the files of a scene's folder, and remembers what they asked for elsewhere.

    Most readers go on without a file that they do not get, so that :attr:`refused` has to be looked at.
    """

    def __init__(self, folder: Path, base: Path) -> None:
        self.folder = folder
        self.base = base
        self.refused: list[str] = []

    def get(self, key: str) -> bytes:
        """Content of a file."""
        name = key.strip()
        # A URI may have what is no letter as %20; a file may be called so.
        for candidate in dict.fromkeys((name, unquote(name))):
            path = inside(self.folder, self.base, candidate)
            if path is not None and path.is_file():
                return path.read_bytes()
            # Exporters write where a file was on their machine; it may have come along.
            beside = inside(self.folder, self.base, PureWindowsPath(candidate).name)
            if path is None and beside is not None and beside.is_file():
                return beside.read_bytes()
            if path is None:
                self.refused.append(name)
                raise ValueError(f"'{name}' is not in the scene's folder")
        raise FileNotFoundError(name)

    def write(self, name: str, data: str | bytes) -> None:
        """Nothing is written beside a scene."""
        raise NotImplementedError

    def namespaced(self, namespace: str) -> "SceneFolder":
        """Return the resolver of a folder in this one."""
        found = SceneFolder(self.folder, self.base / namespace)
        found.refused = self.refused
        return found

    def keys(self) -> list[str]:
        """Names are asked for one by one."""
        return []
