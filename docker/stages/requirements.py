"""Print what extras of pyproject.toml need, with hashes: ``requirements.py REQUIREMENTS.lock EXTRA ...``.

With it an image installs the dependencies before the code is copied, so that a change of the code leaves their layer as
it is. ``build`` stands for what builds the wheel. Only the standard library is needed.
"""

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

BUILD = "build"


def requirements(pyproject: Path, extras: Iterable[str]) -> list[str]:
    """Return the requirements of the package with these extras, extras within extras resolved.

    Raises
    ------
    KeyError
        When there is no such extra.
    """
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    own = re.compile(rf"{re.escape(project['name'])}\[([^\]]+)\]")
    found: dict[str, None] = dict.fromkeys(project["dependencies"])
    waiting, seen = list(extras), set()
    while waiting:
        extra = waiting.pop()
        if extra in seen:
            continue
        seen.add(extra)
        for requirement in project["optional-dependencies"][extra]:
            match = own.fullmatch(requirement)
            if match:
                waiting += [name.strip() for name in match[1].split(",")]
            else:
                found[requirement] = None
    return list(found)


def build_requirements(pyproject: Path) -> list[str]:
    """Return what builds the package."""
    return list(tomllib.loads(pyproject.read_text(encoding="utf-8"))["build-system"]["requires"])


def locked(lock: Path, extras: Iterable[str]) -> str:
    """Return the entries of a lock file that any of these extras needs, for ``pip install --require-hashes``.

    Raises
    ------
    ValueError
        When no entry is for one of them.
    """
    wanted = set(extras)
    entries = re.findall(r"^# \[([^\]]*)\]\n((?:[^#\n].*\n)+)", lock.read_text(encoding="utf-8"), re.MULTILINE)
    known = {extra for needed, _ in entries for extra in needed.split()}
    if not wanted or wanted - known:
        raise ValueError(f"{lock} is for {', '.join(sorted(known))}, and not for {', '.join(sorted(wanted - known))}")
    return "".join(text for needed, text in entries if wanted & set(needed.split()))


if __name__ == "__main__":
    print(locked(Path(sys.argv[1]), sys.argv[2:]), end="")
