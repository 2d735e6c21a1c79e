"""The command line by which the user can run this rayfix again."""

import os
import shlex
import shutil
import sys
from pathlib import Path


def own_command() -> str:
    """Return the beginning of a command line that runs this rayfix.

    It is ``rayfix`` if the shell finds this program by that name, else the path of the program or ``python -m rayfix``.
    """
    program = Path(sys.argv[0])
    if program.name != "rayfix" or not program.is_file():
        return f"{shlex.quote(_shortest(Path(sys.executable)))} -m rayfix"
    found = shutil.which("rayfix")
    if found is not None and os.path.samefile(found, program):
        return "rayfix"
    return shlex.quote(_shortest(program))


def _shortest(path: Path) -> str:
    """Path relative to the current folder if it lies in it. Links are kept, because an environment's Python is one."""
    absolute = Path(os.path.abspath(path))
    try:
        return str(absolute.relative_to(os.getcwd()))
    except ValueError:
        return str(absolute)
