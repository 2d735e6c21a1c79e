"""What the Dockerfile says, read without building it; docker/test_images.py builds and runs the images."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from requirements import locked, requirements
from tests.support.checkout import ROOT

OFFLINE_ONLY = {"trimesh", "scikit-learn", "embreex", "scipy", "networkx", "distributed", "ifcopenshell"}


@pytest.fixture(scope="module")
def stages() -> dict[str, list[str]]:
    """Instructions of each stage, continued lines joined and comments left out."""
    text = (ROOT / "docker/Dockerfile").read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    found: dict[str, list[str]] = {"": []}
    name = ""
    for line in filter(None, map(str.strip, text.splitlines())):
        if line.startswith("FROM "):
            name = line.rpartition(" AS ")[2]
            found[name] = []
        found[name].append(re.sub(r"\s+", " ", line))
    return found


def names(found: list[str]) -> set[str]:
    return {re.match(r"[\w.-]+", requirement)[0] for requirement in found}


def test_the_service_needs_no_offline_package():
    service = names(requirements(ROOT / "pyproject.toml", ["service", "mqtt"]))
    assert {"numpy", "h5py", "numba", "fastapi", "uvicorn", "aiomqtt"} <= service
    assert not service & OFFLINE_ONLY
    assert names(requirements(ROOT / "pyproject.toml", ["offline"])) > {"trimesh", "scikit-learn", "embreex"}


def test_extras_within_extras_are_resolved(tmp_path: Path):
    pyproject = tmp_path / "pyproject.toml"
    pyproject.write_text(
        '[project]\nname = "a"\ndependencies = ["x>=1"]\n[project.optional-dependencies]\n'
        'b = ["a[c,d]", "y[z]"]\nc = ["a[b]", "v"]\nd = ["x>=1", "w"]\n',
        encoding="utf-8",
    )
    assert sorted(requirements(pyproject, ["b"])) == ["v", "w", "x>=1", "y[z]"]
    assert requirements(pyproject, []) == ["x>=1"]
    with pytest.raises(KeyError, match="none"):
        requirements(pyproject, ["none"])


def test_dependencies_are_pinned_and_there_before_the_code(stages: dict[str, list[str]]):
    for name in ("offline-dependencies", "service-dependencies"):
        text = " ".join(stages[name])
        assert re.search(r"requirements\.py requirements\.lock \$\{\w+_EXTRAS\} >requirements\.txt", text)
        assert "--require-hashes --requirement requirements.txt" in text
        assert "--only-binary :all:" in text
        assert "COPY" not in text  # of requirements.lock, which its base has, and nothing else
        assert stages[name][0] == f"FROM tools AS {name}"
    copied = " ".join(line for line in stages["tools"] if line.startswith("COPY"))
    assert copied == "COPY docker/requirements.lock docker/stages/requirements.py ./"


def test_what_builds_the_wheel_is_pinned_by_hash_too(stages: dict[str, list[str]]):
    (install,) = (line for line in stages["wheel"] if "--requirement" in line)
    assert "requirements.py requirements.lock build >build.txt" in install
    assert "--only-binary :all: --require-hashes --requirement build.txt" in install
    (build,) = (line for line in stages["wheel"] if "pip wheel" in line)
    assert "--no-build-isolation" in build
    assert "--no-deps" in build


def test_bases_are_arguments_and_may_be_digests(stages: dict[str, list[str]]):
    bases = {stage[0].split()[1] for name, stage in stages.items() if name}
    arguments = {line.split()[1].partition("=")[0] for line in stages[""] if line.startswith("ARG")}
    for base in bases - set(stages) - {"scratch"}:
        assert re.sub(r".*\$\{(\w+)\}", r"\1", base) in arguments, base


def test_the_defaults_of_the_extras_are_locked(stages: dict[str, list[str]]):
    for name in ("offline-dependencies", "service-dependencies"):
        (extras,) = re.findall(r'ARG \w+_EXTRAS="([^"]*)"', " ".join(stages[name]))
        assert locked(ROOT / "docker/requirements.lock", extras.split())


@pytest.mark.parametrize("name", ["offline", "service"])
def test_images_are_small_in_rights(stages: dict[str, list[str]], name: str):
    stage = stages[name]
    assert not [line for line in stage if line.startswith("RUN")]  # nothing is left behind by a build step
    assert [line for line in stage if line.startswith("USER")] == ["USER 10001:10001"]
    assert stage[0] == ("FROM base AS offline" if name == "offline" else "FROM scratch AS service")
    copied = " ".join(line for line in stage if line.startswith("COPY"))
    assert "/opt/tools" not in copied
    labels = set(re.findall(r"org\.opencontainers\.image\.([\w.]+)=", " ".join(stage)))
    assert labels >= {"title", "description", "licenses", "version", "revision", "base.name"}


def test_the_service_tells_its_health(stages: dict[str, list[str]]):
    (check,) = (line for line in stages["service"] if line.startswith("HEALTHCHECK"))
    command = json.loads(check.partition("CMD ")[2])
    assert command[-1].endswith("/ready.py")
    assert "/readyz" in (ROOT / "docker/image/ready.py").read_text(encoding="utf-8")


def test_secrets_are_mounted_and_not_copied_or_passed(stages: dict[str, list[str]]):
    lines = [line for stage in stages.values() for line in stage]
    fetching = [line for line in lines if line.startswith("RUN") and re.search(r"bin/pip .*install |npm ci", line)]
    assert len([line for line in fetching if "--no-index" not in line]) >= 4
    for line in fetching:
        if "--no-index" not in line:
            assert "--mount=type=secret,id=ca" in line
            assert re.search(r"--mount=type=secret,id=(pip|npm)[, ]", line)
    declared = " ".join(line for line in lines if line.startswith(("ARG", "ENV")))
    assert not re.search(r"INDEX|TOKEN|PASSWORD|PROXY|PIP_|NPM_", declared, re.IGNORECASE)


def test_every_stage_that_is_used_is_there(stages: dict[str, list[str]]):
    used = {name for stage in stages.values() for line in stage for name in re.findall(r"--from=([\w-]+)", line)}
    assert used <= set(stages)
    assert {"viewer-node", "viewer-context"} <= set(stages)


def test_what_is_copied_is_in_the_context(stages: dict[str, list[str]]):
    kept = {
        line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line.startswith("!")
    }
    for stage in stages.values():
        for line in stage:
            if line.startswith("COPY") and "--from=" not in line:
                for source in line.split()[1:-1]:
                    assert (ROOT / source).exists(), line
                    assert any(source == name or source.startswith(f"{name}/") for name in kept), line


def test_a_start_copies_the_kernels_and_becomes_rayfix(tmp_path: Path):
    (tmp_path / "kernels/a").mkdir(parents=True)
    (tmp_path / "kernels/a/f.nbi").write_bytes(b"kernel")
    environment = {"RAYFIX_KERNELS": str(tmp_path / "kernels"), "NUMBA_CACHE_DIR": str(tmp_path / "tmp/cache")}
    environment["PYTHONPATH"] = ":".join(sys.path)
    command = [sys.executable, str(ROOT / "docker/image/start.py"), "--version"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("rayfix ")
    assert (tmp_path / "tmp/cache/a/f.nbi").read_bytes() == b"kernel"

    (tmp_path / "file").touch()
    environment["NUMBA_CACHE_DIR"] = str(tmp_path / "file/cache")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "--tmpfs" in done.stderr
