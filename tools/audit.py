"""Known vulnerabilities of what the images install, by pip-audit.

    python tools/audit.py PYTHON

PYTHON is an interpreter that has pip-audit. It fails for known vulnerabilities alone. Where packages could not be
audited, because the database cannot be reached or does not know them, it says so in one line, with the reason.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_LOCK = Path(__file__).resolve().parents[1] / "docker" / "requirements.lock"
_SECONDS = 60
_OPTIONS = ("--require-hashes", "--disable-pip", "--progress-spinner", "off", "--timeout", "5", "--format", "json")


def audit(command: Sequence[str], *, seconds: float = _SECONDS) -> tuple[int, str]:
    """Run pip-audit; returns the exit status and what to print.

    Parameters
    ----------
    command : sequence of str
        How pip-audit is called so that it writes JSON.
    seconds : float
        Time for it.
    """
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return 0, f"could not audit: the database did not answer within {seconds:g} s"
    except OSError as error:
        return 0, f"could not audit: {command[0]} cannot be run ({error.strerror})"
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError, TypeError):
        reason = (done.stderr.strip().splitlines() or [f"pip-audit ended with status {done.returncode}"])[-1]
        return 0, f"could not audit: {reason}"
    return judge(packages)


def judge(packages: Sequence[dict[str, Any]]) -> tuple[int, str]:
    """Return the exit status and what to print for the packages that pip-audit lists."""
    found = [
        f"{package['name']} {package['version']} has the known vulnerability {vulnerability['id']}; "
        + (f"fixed in {', '.join(fixed)}" if (fixed := vulnerability.get("fix_versions")) else "there is no fix yet")
        for package in packages
        for vulnerability in package.get("vulns", ())
    ]
    left_out = [package["skip_reason"] for package in packages if "skip_reason" in package]
    audited = len(packages) - len(left_out)
    lines = list(found)
    if left_out:
        lines.append(f"could not audit {len(left_out)} of {len(packages)} packages, the first because: {left_out[0]}")
    if audited and not found:
        lines.append(f"{audited} packages audited: no known vulnerability")
    if not packages:
        lines.append("could not audit: pip-audit lists no package")
    return (1 if found else 0), "\n".join(lines)


def main() -> None:
    """Audit what the images install."""
    status, text = audit([sys.argv[1], "-m", "pip_audit", "--requirement", str(_LOCK), *_OPTIONS])
    print(f"== {text}")
    sys.exit(status)


if __name__ == "__main__":
    main()
