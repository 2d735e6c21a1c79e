"""`make audit` fails for known vulnerabilities alone, and says in one line what it could not audit."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

_SPEC = importlib.util.spec_from_file_location("audit", Path(__file__).resolve().parents[2] / "tools" / "audit.py")
assert _SPEC is not None
assert _SPEC.loader is not None
audit = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(audit)

SOUND = {"name": "numpy", "version": "2.4.0", "vulns": []}
UNKNOWN = {"name": "scipy", "skip_reason": "Dependency not found on PyPI and could not be audited: scipy (1.17.1)"}
VULNERABLE = {
    "name": "jinja2",
    "version": "2.4.1",
    "vulns": [{"id": "PYSEC-2014-8", "fix_versions": ["2.7.2"], "aliases": [], "description": "."}],
}


def run(code: str, *, seconds: float = 60.0) -> tuple[int, str]:
    return audit.audit([sys.executable, "-c", code], seconds=seconds)


def writing(*packages: dict, status: int = 0) -> str:
    text = json.dumps({"dependencies": packages, "fixes": []})
    return f"import sys; print({text!r}); sys.exit({status})"


@pytest.mark.parametrize("others", [(), (SOUND,), (UNKNOWN,), (SOUND, UNKNOWN)])
def test_a_known_vulnerability_fails(others: tuple[dict, ...]):
    status, text = run(writing(*others, VULNERABLE, status=1))
    assert status == 1
    assert text.splitlines()[0] == "jinja2 2.4.1 has the known vulnerability PYSEC-2014-8; fixed in 2.7.2"


def test_no_known_vulnerability():
    assert run(writing(SOUND, SOUND)) == (0, "2 packages audited: no known vulnerability")


def test_packages_that_the_database_does_not_know_are_one_line():
    status, text = run(writing(UNKNOWN, UNKNOWN))
    assert (status, text) == (0, f"could not audit 2 of 2 packages, the first because: {UNKNOWN['skip_reason']}")


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("import nothing_of_this_name", "No module named 'nothing_of_this_name'"),
        ("import sys; print('x', file=sys.stderr); sys.exit('ServiceError: no connection')", "no connection"),
        ("import sys; sys.exit(3)", "pip-audit ended with status 3"),
        ("print('[]')", "pip-audit ended with status 0"),
        (writing(), "lists no package"),
    ],
)
def test_where_nothing_can_be_audited_a_line_says_why(code: str, why: str):
    status, text = run(code)
    assert status == 0
    assert text.startswith("could not audit: ")
    assert why in text
    assert "\n" not in text


def test_a_silent_database():
    assert run("import time; time.sleep(60)", seconds=0.2) == (
        0,
        "could not audit: the database did not answer within 0.2 s",
    )


def test_no_interpreter():
    status, text = audit.audit(["/nowhere/python"])
    assert (status, text) == (0, "could not audit: /nowhere/python cannot be run (No such file or directory)")
