"""What is public: names, their homes, and the tree of errors."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rayfix
import rayfix.client
import rayfix.errors
from tests.support.checkout import ROOT

SOURCES = [
    ROOT / "rayfix",
    *(ROOT / part / f"rayfix_{part}" for part in ("offline", "service", "tables", "evaluation")),
]
ROOTS = ["rayfix", "rayfix_evaluation", "rayfix_offline", "rayfix_service", "rayfix_tables"]

BUILT_BY_HAND = """
import sys
for name in ("numba", "httpx", "pydantic", "fastapi", "trimesh", "joblib"):
    sys.modules[name] = None
import rayfix
report = rayfix.Report(
    measurements=(
        rayfix.Angle(station_id="a", azimuth=0.1, azimuth_stdev=0.02, error_model=rayfix.HEAVY_TAILED),
        rayfix.Range(station_id="a", path_length=4.0, stdev=0.5),
    ),
    height=rayfix.Height(z=1.2, stdev=0.1),
)
rayfix.FusionSettings(beam_width=64)
try:
    rayfix.Locator
except rayfix.MissingExtraError as error:
    print(error)
"""


def type_checked_names() -> dict[str, str]:
    """Names of the package that a type checker sees as its own, by ``import X as X`` or an import outside of ``if``."""
    tree = ast.parse(Path(rayfix.__file__).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    return {
        alias.asname or alias.name: node.module or ""
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.name == alias.asname
    }


def test_all_is_what_can_be_imported_and_what_type_checkers_see() -> None:
    assert len(set(rayfix.__all__)) == len(rayfix.__all__)
    lazy = type_checked_names()
    eager = {name for name in rayfix.__all__ if name not in lazy}
    assert set(rayfix.__all__) == set(lazy) | eager
    for name, module in lazy.items():
        value = getattr(rayfix, name)
        assert value is getattr(importlib.import_module(module), name)
        assert rayfix._HOMES[name][0] == module
    assert set(rayfix._HOMES) == set(lazy)
    assert eager <= set(vars(rayfix))
    assert eager - {"Table", "__version__"} == set(rayfix.errors.__all__)
    assert set(rayfix.__all__) <= set(dir(rayfix))
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        rayfix.nothing  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("module", [rayfix.client, rayfix.errors])
def test_all_of_a_module_can_be_imported(module: object) -> None:
    names = module.__all__  # type: ignore[attr-defined]
    assert len(set(names)) == len(names)
    assert all(hasattr(module, name) for name in names)


@pytest.mark.parametrize("name", ROOTS)
def test_each_root_says_what_is_public(name: str) -> None:
    assert "public" in (importlib.import_module(name).__doc__ or "")


def test_the_package_names_all_of_its_public_names() -> None:
    described = set(re.findall(r"``(\w+)``", rayfix.__doc__ or ""))
    functions = {name for name in rayfix.__all__ if name.startswith("range_from_")}
    assert set(rayfix.__all__) - functions - set(rayfix.errors.__all__) - {"__version__"} - LAZY_ERRORS <= described


LAZY_ERRORS = {"BrokerError", "HubError", "ServiceError"}
"""Errors whose modules need an extra."""


def drawn_tree() -> set[tuple[str, str]]:
    """Pairs of an error and its parent in the drawing."""
    pairs, above = set(), ["Exception"]
    for line in (rayfix.errors.__doc__ or "").splitlines():
        found = re.match(r"    ([│├└─ ]*)(\w+Error) +\S", line)
        if found:
            depth = len(found[1]) // 4
            del above[depth + 1 :]
            pairs.add((found[2], above[-1]))
            above.append(found[2])
    return pairs


def written_tree() -> set[tuple[str, str]]:
    """Pairs of an error and its parent in the sources, of those that descend from RayfixError."""
    bases: dict[str, list[str]] = {}
    for path in (path for source in SOURCES for path in source.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                names = [ast.unparse(base) for base in node.bases]
                if node.name == "RayfixError" or any(name.endswith("Error") for name in names):
                    bases.setdefault(node.name, []).extend(names)
    ours = {"RayfixError"}
    while True:
        more = {name for name, parents in bases.items() if ours & set(parents)} - ours
        if not more:
            break
        ours |= more
    return {(name, base) for name in ours for base in bases[name] if base in ours} | {("RayfixError", "Exception")}


def test_the_tree_of_errors_is_drawn_as_it_is() -> None:
    assert drawn_tree() == written_tree()
    names = {name for name, _ in drawn_tree()}
    assert names - set(rayfix.__all__) == {"InvalidReportError", "MalformedJsonError"}
    for name in names & set(rayfix.__all__):
        assert issubclass(getattr(rayfix, name), rayfix.RayfixError)


def test_a_report_can_be_built_without_any_extra() -> None:
    done = subprocess.run([sys.executable, "-c", BUILT_BY_HAND], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "install it with: pip install 'rayfix[service]'" in done.stdout
