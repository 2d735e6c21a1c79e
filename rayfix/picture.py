"""Files of pictures: what is wrong with a name is said before the work, and writing has one clear error."""

from pathlib import Path

from matplotlib.figure import Figure

from rayfix_tables.errors import RayfixError

TYPES = (".png", ".svg", ".pdf")

_DOTS_PER_INCH = 130


def check_picture(path: Path) -> None:
    """Refuse a name under which no picture can be written.

    Raises
    ------
    RayfixError
        When the type is unknown, or there is no such folder.
    """
    if path.suffix.lower() not in TYPES:
        raise RayfixError(f"{path} is no name of a picture; end it in {', '.join(TYPES[:-1])} or {TYPES[-1]}")
    if not path.parent.is_dir():
        raise RayfixError(f"cannot write {path}: there is no folder {path.parent}; create it first")


def save_picture(figure: Figure, path: str | Path) -> None:
    """Write a figure; its file's suffix says the type.

    Raises
    ------
    RayfixError
        When it cannot be written.
    """
    path = Path(path)
    check_picture(path)
    try:
        figure.savefig(path, dpi=_DOTS_PER_INCH)
    except OSError as error:
        raise RayfixError(f"cannot write {path} ({error.strerror}); give another name") from error
