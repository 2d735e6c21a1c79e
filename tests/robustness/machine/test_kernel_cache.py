"""Without a writable folder for compiled kernels beside the package or at home, rayfix starts nevertheless."""

import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rayfix_tables.gaussians import kernel_cache
from rayfix_tables.gaussians.kernel_cache import ensure_kernel_cache
from tests.support.checkout import ROOT

PACKAGES = (
    "rayfix",
    "evaluation/rayfix_evaluation",
    "offline/rayfix_offline",
    "service/rayfix_service",
    "tables/rayfix_tables",
)

IMPORT_ALL_KERNELS = """
import rayfix_service.locator, rayfix_offline.build, rayfix_evaluation.truth.forward
import os, sys
print(os.environ.get("NUMBA_CACHE_DIR"))
"""

IMPORT = """
import os, rayfix_service
print(os.environ.get("NUMBA_CACHE_DIR"))
"""

COMPILE_ONE = """
import numpy as np
from rayfix_service.fusion.posterior.principal_axes import semi_axes
print(semi_axes(np.eye(3)).shape)
"""

WHERE = """
from rayfix_service.fusion.posterior.principal_axes import semi_axes
print(semi_axes.stats.cache_path)
"""

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the packages in which nothing can be kept, not even by root: each ``__pycache__`` is a file."""
    target = tmp_path_factory.mktemp("installed")
    skipped = shutil.ignore_patterns("__pycache__", "frontend", "static", "node_modules")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, target / Path(package).name, ignore=skipped)
    for folder in [path for path in target.rglob("*") if path.is_dir()]:
        (folder / "__pycache__").touch()
    return target


@pytest.fixture
def run(installed: Path, tmp_path: Path) -> Run:
    """Return a function that runs Python with these packages, a file for a home, and a temporary folder of its own."""
    (tmp_path / "home").touch()
    (tmp_path / "tmp").mkdir()
    wanted = {"PATH": os.environ["PATH"], "PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1"}
    wanted |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path / "tmp")}

    def start(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *arguments],
            env={**wanted, **environment},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    return start


def test_kernels_go_to_a_private_temporary_folder(run: Run, tmp_path: Path) -> None:
    """One line says where; numba without help ends in 'no locator available'."""
    done = run("-c", IMPORT_ALL_KERNELS)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "tmp" / f"rayfix-kernels-{os.geteuid()}"
    assert done.stdout.strip() == str(folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"compiled kernels go to {folder}, as neither")
    assert "set NUMBA_CACHE_DIR" in line


def test_the_next_process_finds_what_the_first_has_compiled(run: Run, tmp_path: Path) -> None:
    assert run("-c", COMPILE_ONE).stdout == "(3, 3)\n"
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "tmp").rglob("*.nbc")}
    assert kept
    assert run("-c", COMPILE_ONE).stdout == "(3, 3)\n"
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "tmp").rglob("*.nbc")} == kept


@pytest.mark.parametrize("command", [("locate", "none.h5", "none.json"), ("serve", "none.h5"), ("check", "none.toml")])
def test_commands_start_and_their_errors_are_lines(run: Run, command: tuple[str, ...]) -> None:
    done = run("-m", "rayfix", *command)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert any(line.startswith("rayfix: ") and "none." in line for line in done.stderr.splitlines()), done.stderr


def test_without_any_folder_one_line_says_so(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In this process, since the machine's own temporary folders can be written to."""
    nowhere = tmp_path / "home" / "below-a-file"
    monkeypatch.setattr(kernel_cache, "_temporary_parents", lambda: iter([nowhere]))
    monkeypatch.setattr(kernel_cache, "_user_cache", lambda: None)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    with pytest.raises(
        kernel_cache.RayfixError, match=r"no folder for compiled kernels: none of .* set NUMBA_CACHE_DIR"
    ):
        ensure_kernel_cache(nowhere)


@pytest.mark.parametrize("home", ["HOME", "XDG_CACHE_HOME"])
def test_the_users_cache_comes_first(run: Run, tmp_path: Path, home: str) -> None:
    (tmp_path / "cache").mkdir()
    done = run("-c", IMPORT, **{home: str(tmp_path / "cache")})
    assert (done.stdout, done.stderr) == ("None\n", "")


def test_a_folder_that_is_named_comes_first(run: Run, tmp_path: Path) -> None:
    done = run("-c", IMPORT, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    assert (done.stdout, done.stderr) == (f"{tmp_path / 'mine'}\n", "")


def test_without_a_home_no_folder_called_tilde_is_made(run: Run, tmp_path: Path) -> None:
    """A user without an entry in the user database has no home either."""
    done = run("-c", IMPORT, HOME="~")
    assert "rayfix-kernels" in done.stdout
    assert not (tmp_path / "~").exists()


def test_a_process_that_has_numba_already(run: Run) -> None:
    done = run("-c", "import numba\n" + WHERE)
    assert done.returncode == 0, done.stderr
    assert "rayfix-kernels" in done.stdout


@pytest.mark.parametrize("kind", ["link", "open folder", "file"])
def test_a_name_that_others_have_taken_is_not_used(run: Run, tmp_path: Path, kind: str) -> None:
    """Compiled kernels are run: whoever could put some there would run code as this user."""
    taken = tmp_path / "tmp" / f"rayfix-kernels-{os.geteuid()}"
    if kind == "link":
        (tmp_path / "theirs").mkdir()
        taken.symlink_to(tmp_path / "theirs", target_is_directory=True)
    elif kind == "file":
        taken.touch()
    else:
        taken.mkdir()
        taken.chmod(0o777)
    done = run("-c", WHERE)
    (other,) = [path for path in (tmp_path / "tmp").iterdir() if path != taken]
    assert Path(done.stdout.strip()).is_relative_to(other)
    assert stat.S_IMODE(other.stat().st_mode) == 0o700
    assert not list(tmp_path.rglob("theirs/*"))


@pytest.mark.parametrize(("changed", "expected"), [("callee", 30.0), ("constant", 21.0), ("other", 3.0)])
def test_kernels_of_a_former_version_are_forgotten(tmp_path: Path, changed: str, expected: float) -> None:
    """Numba compared the caller's own file only, and ran its old copy of the callee: wrong numbers, or a crash."""
    package = tmp_path / "rayfix_made"
    (package / "inner").mkdir(parents=True)
    (package / "inner" / "__init__.py").touch()
    head = "from pathlib import Path\nfrom rayfix_tables.gaussians.kernel_cache import ensure_kernel_cache\n"
    (package / "__init__.py").write_text(f"{head}ensure_kernel_cache(Path(__file__).parent)\n")
    kernel = "import numba\n{}\n\n@numba.njit(cache=True)\ndef {}(x):\n    return {}\n"
    caller = "from rayfix_made.inner.callee import one\nfrom rayfix_made.inner.constant import SCALE"
    texts = {
        "callee": kernel.format("", "one", "x + 2.0"),
        "caller": kernel.format(caller, "two", "SCALE * one(x)"),
        "constant": "SCALE = 1.0\n",
        "other": "UNUSED = 1.0\n",
    }
    for name, text in texts.items():
        (package / "inner" / f"{name}.py").write_text(text)

    def value() -> tuple[float, int]:
        """Return what the kernel gives, and how many were taken from the cache."""
        script = "from rayfix_made.inner.caller import two\nprint(two(1.0), sum(two.stats.cache_hits.values()))"
        environment = {name: text for name, text in os.environ.items() if not name.startswith("NUMBA_")}
        done = subprocess.run(
            [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        number, hits = done.stdout.split()
        return float(number), int(hits)

    assert value() == (3.0, 0)
    assert value() == (3.0, 1)
    text = texts[changed].replace("1.0", "7.0").replace("2.0", "29.0")
    (package / "inner" / f"{changed}.py").write_text(text)
    assert value() == (expected, int(changed == "other"))
    assert value() == (expected, 1)
