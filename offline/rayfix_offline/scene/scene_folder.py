"""Files that a scene refers to; only files in its folder are read."""

from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from rayfix_tables.errors import SceneError


def inside(folder: Path, base: Path, name: str) -> Path | None:
    """Return the path of a file that a scene refers to, None if it is outside of the scene's folder.

    Parameters
    ----------
    folder : Path
        The scene's.
    base : Path
        Folder of the file that refers to it, within ``folder``.
    name : str
        Relative to ``base``. Links are resolved.
    """
    try:
        path = (base / name).resolve()
    except (OSError, RuntimeError, ValueError):  # a name that is too long, a cycle of links, a zero byte
        return base / "no such file"
    return path if path.is_relative_to(folder.resolve()) else None


def is_file(path: Path) -> bool:
    """Whether a path is a file; False for an invalid path."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def outside_error(where: str, name: str) -> SceneError:
    """Return the error for a file outside of the scene's folder."""
    return SceneError(
        f"{where} names the file '{name[:200]}', which is not in the scene's folder; put it there and name it relative "
        "to the file that needs it"
    )


class SceneFolder:
    """Finds the files of a scene's folder, and records references to files elsewhere."""

    def __init__(self, folder: Path, base: Path) -> None:
        self.folder = folder
        self.base = base
        self.refused: list[str] = []

    def find(self, name: str) -> Path | None:
        """Return the path of a file that the scene refers to, None if it is missing.

        A URI may be percent-encoded, and a file name may contain such codes. Exporters write paths of their machine,
        perhaps with another system's separators; the file may be in the scene's folder.
        """
        name = name.strip()
        candidates = dict.fromkeys((name, unquote(name)))
        paths = [inside(self.folder, self.base, candidate) for candidate in candidates]
        beside = [
            inside(self.folder, self.base, each)
            for candidate in candidates
            for each in (candidate.replace("\\", "/"), PureWindowsPath(candidate).name)
            if each
        ]
        for path in (*paths, *beside):
            if path is not None and is_file(path):
                return path
        if None in paths:
            self.refused.append(name)
        return None

    def refuse_outside(self, where: str) -> None:
        """Raise if the scene refers to a file elsewhere.

        Raises
        ------
        SceneError
        """
        if self.refused:
            raise outside_error(where, self.refused[0])
