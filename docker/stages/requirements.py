"""Print what extras of pyproject.toml need, one requirement a line: ``requirements.py PYPROJECT.toml EXTRA ...``.

With it an image installs the dependencies before the code is copied, so that a change of the code leaves their layer as
it is. Only the standard library is needed.
"""

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path


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


if __name__ == "__main__":
    print("\n".join(requirements(Path(sys.argv[1]), sys.argv[2:])))
