"""Check the packages that a user would install: ``python tests/package/check_wheel.py dist``.

The wheel goes into clean environments outside the checkout. With all extras it runs the demo; with the service's extra
alone it answers a report from the demo's table, and neither trimesh nor scikit-learn nor embreex is there.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OFFLINE_ONLY = ("trimesh", "sklearn", "embreex")


def main() -> None:
    dist = Path(sys.argv[1]).resolve()
    (wheel,) = dist.glob("*.whl")
    (sdist,) = dist.glob("*.tar.gz")
    print(f"{wheel.name}: {wheel.stat().st_size / 1024:.0f} KiB, {sdist.name}: {sdist.stat().st_size / 1024:.0f} KiB")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        full = install(work / "full", wheel, "all")
        output = run(work, full / "rayfix", "demo")
        print(output)
        error = re.search(r"error +([0-9.]+) m", output)
        if error is None or not float(error.group(1)) < 0.5:
            sys.exit("the demo's position is not within 0.5 m of the truth")
        if not (work / "demo" / "fix.png").stat().st_size:
            sys.exit("the demo wrote no picture")

        service = install(work / "service", wheel, "service")
        for module in OFFLINE_ONLY:
            found = run(work, service / "python", "-c", f"import importlib.util as u; print(u.find_spec('{module}'))")
            if found.strip() != "None":
                sys.exit(f"the service's environment has {module}")
        answer = run(work, service / "rayfix", "locate", "demo/hall.h5", "demo/report.json", "--json")
        print(f"located without the offline extra: {json.loads(answer)['position']}")
        check_viewer(work, service / "python")


PAGE = """
import asyncio, httpx, pathlib
from rayfix_service.server.app import create_app
from rayfix_service.web.assets import load_assets

async def main():
    app = create_app(pathlib.Path("demo/hall.h5"))
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
        viewer, interface = [await client.get(name) for name in ("/", "/docs")]
        files = [await client.get(name) for name in load_assets() if "/" in name]
    whole = "assets/" in viewer.text and "interface/" in interface.text
    print(whole, len(files), all(answer.status_code == 200 for answer in (viewer, interface, *files)))

asyncio.run(main())
"""


def check_viewer(folder: Path, python: Path) -> None:
    """Ask the installed service for its viewer and the page of its interface."""
    subprocess.run([str(python), "-m", "pip", "install", "--quiet", "httpx"], check=True)
    answer = run(folder, python, "-c", PAGE).strip()
    if answer == "True 5 True":
        print("the wheel has the viewer")
    elif not (ROOT / "service" / "rayfix_service" / "web" / "static" / "index.html").is_file():
        print("the wheel has NO viewer, since it could not be built here; 'make viewer' says why")
    else:
        sys.exit(f"the wheel's viewer is not whole: {answer}")


def install(folder: Path, wheel: Path, extra: str) -> Path:
    """Install the wheel into a new environment and return its folder of programs."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "--constraint", str(ROOT / "constraints.txt"), f"{wheel}[{extra}]"], check=True)
    return folder / "bin"


def run(folder: Path, *command: str | Path) -> str:
    """Run a program outside the checkout and return what it printed."""
    environment = {k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "VIRTUAL_ENV"}}
    done = subprocess.run(
        [str(c) for c in command], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode:
        print(done.stdout)
        sys.exit(f"{' '.join(str(c) for c in command)} ended with status {done.returncode}")
    return done.stdout


if __name__ == "__main__":
    main()
