"""List what the service needs that has no wheel for a processor: ``check_wheels.py [--machine aarch64]``.

pip resolves the service's requirements for this machine, then looks for a wheel of each for the other. Nothing is
installed, and only metadata is fetched. Ends with status 1 when anything is missing. ``make package`` calls this.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docker/stages"))

from requirements import requirements  # noqa: E402

GLIBC = range(17, 37)
"""Minor versions of glibc 2 that wheels may ask for: Debian bookworm has 2.36."""


def main() -> None:
    parser = argparse.ArgumentParser(description="List what the service needs that has no wheel for a processor.")
    parser.add_argument("--machine", default="aarch64")
    parser.add_argument("--python", default="3.11", help="version of the image's Python (default: 3.11)")
    parser.add_argument("extras", nargs="*", default=["service", "mqtt"])
    options = parser.parse_args()
    needed = resolve(requirements(ROOT / "pyproject.toml", options.extras))
    target = ["--only-binary=:all:", "--python-version", options.python, "--implementation", "cp"]
    target += [f"--platform=manylinux_2_{minor}_{options.machine}" for minor in GLIBC]
    if resolve(needed, "--no-deps", *target) is None:
        missing = [name for name in needed if resolve([name], "--no-deps", *target) is None]
        sys.exit(f"no wheel for {options.machine} and Python {options.python}: {', '.join(missing)}")
    print(f"all {len(needed)} have a wheel for {options.machine} and Python {options.python}: {', '.join(needed)}")


def resolve(wanted: list[str], *options: str) -> list[str] | None:
    """Return what pip would install, as ``name==version``; None when it cannot."""
    report = ["--dry-run", "--ignore-installed", "--quiet", "--report", "-", "--target", "unused"]
    constraint = ["--constraint", str(ROOT / "constraints.txt")]
    command = [sys.executable, "-m", "pip", "install", *report, *constraint, *options, *wanted]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        if not options:
            sys.exit(done.stderr)
        return None
    return sorted(f"{i['metadata']['name']}=={i['metadata']['version']}" for i in json.loads(done.stdout)["install"])


if __name__ == "__main__":
    main()
