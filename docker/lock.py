"""Write ``docker/requirements.lock``: what the images install, with the hashes of its wheels: ``lock.py``.

pip resolves each extra under ``constraints.txt`` for this machine, then names the wheel of each package for each of the
images' processors and Pythons. Nothing is installed, and only metadata is fetched. ``requirements.py --lock`` reads the
file; the images install from it with ``--require-hashes``. Run it after a change of ``constraints.txt`` or
of ``pyproject.toml``; a test tells when it was forgotten.
"""

import json
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "docker/requirements.lock"
sys.path.insert(0, str(ROOT / "docker/stages"))

from requirements import BUILD, build_requirements, requirements  # noqa: E402

EXTRAS = ("cluster", "ifc", "mqtt", "offline", "service")
MACHINES = ("x86_64", "aarch64")
PYTHONS = ("3.11", "3.12", "3.13")
GLIBC = range(17, 37)
"""Minor versions of glibc 2 that wheels may ask for: Debian bookworm has 2.36."""

HEAD = """\
# What the images install: each package with its hashes and, in brackets, the extras that need it.
# Written by docker/lock.py; do not edit.
"""


def main() -> None:
    pyproject = ROOT / "pyproject.toml"
    wanted = {extra: requirements(pyproject, [extra]) for extra in EXTRAS} | {BUILD: build_requirements(pyproject)}
    needed: dict[str, set[str]] = {}
    for extra, names in wanted.items():
        found = resolve(names, "--constraint", str(ROOT / "constraints.txt"))
        if isinstance(found, str):
            sys.exit(f"{found} of the extra {extra} has no wheel for this machine")
        for item in found:
            needed.setdefault(pinned(item), set()).add(extra)
    hashes: dict[str, set[str]] = {name: set() for name in needed}
    for machine in MACHINES:
        for python in PYTHONS:
            for item in wheels(sorted(needed), machine, python):
                hashes[pinned(item)].add(sha256_of(item))
    missing = [name for name, found in hashes.items() if not found]
    if missing:
        sys.exit(f"no wheel at all: {', '.join(missing)}")
    entries = [entry(name, sorted(hashes[name]), sorted(needed[name])) for name in sorted(needed)]
    LOCK.write_text(HEAD + "".join(entries), encoding="utf-8")
    print(f"{LOCK.relative_to(ROOT)}: {len(needed)} packages, {sum(map(len, hashes.values()))} wheels")


def entry(name: str, hashes: Iterable[str], extras: Iterable[str]) -> str:
    lines = [f"# [{' '.join(extras)}]", f"{name} \\", *(f"    --hash=sha256:{each} \\" for each in hashes)]
    return "\n".join(lines).removesuffix(" \\") + "\n"


def wheels(names: list[str], machine: str, python: str) -> list[dict[str, Any]]:
    """Return the wheels for a processor and a Python; what has none there is left out."""
    target = ["--no-deps", "--only-binary=:all:", "--python-version", python, "--implementation", "cp"]
    target += [f"--platform=manylinux_2_{minor}_{machine}" for minor in GLIBC]
    left = list(names)
    while left:
        found = resolve(left, *target)
        if not isinstance(found, str):
            print(f"{len(found)} wheels for {machine} and Python {python}", file=sys.stderr)
            return found
        print(f"{found} has no wheel for {machine} and Python {python}", file=sys.stderr)
        left.remove(found)
    return []


def resolve(wanted: list[str], *options: str) -> list[dict[str, Any]] | str:
    """Return what pip would install, or the first of the packages that it finds no wheel of."""
    report = ["--dry-run", "--ignore-installed", "--quiet", "--report", "-", "--target", "unused"]
    command = [sys.executable, "-m", "pip", "install", *report, *options, *wanted]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return list(json.loads(done.stdout)["install"])
    missing = re.search(r"No matching distribution found for (\S+)", done.stderr)
    if missing is None or missing[1] not in wanted:
        sys.exit(done.stderr)
    return missing[1]


def pinned(item: dict[str, Any]) -> str:
    name = re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower()
    return f"{name}=={item['metadata']['version']}"


def sha256_of(item: dict[str, Any]) -> str:
    source = item["download_info"]
    if source["url"].startswith("file:"):
        sys.exit(f"{pinned(item)} comes from a folder of this machine, which may hold other files than the registry's")
    return str(source["archive_info"]["hashes"]["sha256"])


if __name__ == "__main__":
    main()
