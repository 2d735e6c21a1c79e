"""Bills of materials (CycloneDX, JSON) of the wheel and of the images.

The wheel's is that of an environment with nothing but the wheel and all its extras, by cyclonedx-bom; the images' are
made from the lock by which they install, in which each package stands with its version and hashes.
"""

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main(dist: Path) -> None:
    (wheel,) = dist.glob("*.whl")
    tool = [sys.executable, "-m", "cyclonedx_py"]
    options = ["--output-format", "JSON", "--output-reproducible"]
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = str(Path(folder) / "bin" / "python")
        limits = ["--constraint", str(ROOT / "constraints.txt")]
        subprocess.run([python, "-m", "pip", "install", "--quiet", *limits, f"{wheel}[all]"], check=True)
        subprocess.run([python, "-m", "pip", "uninstall", "--quiet", "--yes", "pip", "setuptools"], check=True)
        output = str(dist / "wheel.cdx.json")
        subprocess.run([*tool, "environment", *options, "--output-file", output, python], check=True)
    lock = str(ROOT / "docker" / "requirements.lock")
    subprocess.run([*tool, "requirements", *options, "--output-file", str(dist / "images.cdx.json"), lock], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
