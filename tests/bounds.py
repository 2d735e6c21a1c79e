"""Run the quick tests with other versions of the libraries than constraints.txt has.

    python tests/bounds.py lowest|newest [--quick] [ARGUMENTS OF PYTEST]

``lowest`` takes the lowest versions that pyproject.toml asks for by name, so that its bounds are true; ``newest`` the
newest of everything. Each has an environment of its own, ``.venv-lowest`` or ``.venv-newest``, with
its own compiled kernels. ``--quick`` runs a few tests only: imports, a build, a fix, requests.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = ("all", "ifc")

TESTS = ("tests/tables", "tests/offline", "tests/service", "tests/client", "tests/rayfix", "tests/evaluation")
QUICK_TESTS = (
    "tests/rayfix/test_api.py::test_everything_in_all_can_be_imported",
    "tests/rayfix/test_cli.py::test_example_check_build_info_verify_locate",
    "tests/service/http/routes/test_streams.py::test_what_is_no_stream_is_refused_before_it_opens",
    "tests/service/server/test_server.py::test_a_real_server_answers_and_ends",
    "tests/client/test_service.py::test_a_stream_answers_each_report",
)

# Old releases use what newer libraries, which nobody asks for by name, call deprecated. And pydantic's version decides
# how numbers are written in the OpenAPI document.
LOWEST_OPTIONS = (
    "-Wignore::DeprecationWarning",
    "-Wignore::PendingDeprecationWarning",
    "--deselect=tests/service/http/test_fuzz.py::test_the_committed_document_is_that_of_the_code",
)


def main(arguments: list[str]) -> int:
    """Make the environment and run the tests in it; the status of pytest."""
    if not arguments or arguments[0] not in ("lowest", "newest"):
        sys.exit(__doc__)
    which, rest = arguments[0], arguments[1:]
    python = make_environment(which)
    quick = "--quick" in rest
    rest = [argument for argument in rest if argument != "--quick"]
    chosen = rest or (list(QUICK_TESTS) if quick else ["--numprocesses", "auto", "--dist", "loadfile", *TESTS])
    options = LOWEST_OPTIONS if which == "lowest" else ()
    environment = os.environ | {"NUMBA_CACHE_DIR": str(python.parents[1] / "kernels")}
    command = [str(python), "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *options, *chosen]
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


def make_environment(which: str) -> Path:
    """Make an environment with these versions, or bring it up to date; returns its Python."""
    folder = ROOT / f".venv-{which}"
    python = folder / "bin" / "python"
    if not python.exists():
        run(sys.executable, "-m", "venv", str(folder))
    run(str(python), "-m", "pip", "install", "--quiet", "--upgrade", "uv")
    uv = [str(python), "-m", "uv", "pip"]
    extras = [f"--extra={extra}" for extra in EXTRAS]
    pins = folder / "pins.txt"
    resolution = "lowest-direct" if which == "lowest" else "highest"
    compiled = ["compile", "--quiet", "--upgrade", "--no-annotate", "--no-header", "--output-file", str(pins)]
    run(*uv, *compiled, f"--resolution={resolution}", "--python", str(python), *extras, "pyproject.toml")
    print(pins.read_text(encoding="utf-8"), flush=True)
    run(*uv, "install", "--quiet", "--python", str(python), "--requirement", str(pins), "--group", "dev")
    run(*uv, "install", "--quiet", "--python", str(python), "--no-deps", "--editable", ".")
    return python


def run(*command: str) -> None:
    """Run a program in the checkout, or end with its status."""
    done = subprocess.run(command, cwd=ROOT, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command[:6])} ... ended with status {done.returncode}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
