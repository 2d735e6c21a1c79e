"""Run the numerical tests as they would run on other processors.

    python tests/portable.py [ARGUMENTS OF PYTEST]

Processors differ in their kernels and so in their rounding: OpenBLAS and NumPy choose kernels by what the processor can
do, and LLVM compiles numba's. Each run below takes kernels of an older processor, without wide vectors and fused
multiply-add where the architecture has them, and says so only after it has asked the libraries. numba's kernels go to a
cache of their own, which both runs share.
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]

# Formats of files, damaged tables and interrupted builds do not depend on rounding.
NUMERICAL = (
    *(
        f"tests/tables/{name}"
        for name in ("gaussians", "geometry", "test_mixture.py", "test_grid.py", "test_freespace.py")
    ),
    *(f"tests/offline/{name}" for name in ("fit", "rays", "twin", "scene/test_slabs.py", "scene/test_walls.py")),
    *("tests/offline/test_build.py", "tests/service/fusion", "tests/service/tracking", "tests/evaluation"),
)

# Where threads share the work, or libraries do that have kernels of their own for several.
OF_THREADS = (
    "tests/offline/fit",
    "tests/offline/rays",
    "tests/service/fusion/product",
    "tests/service/fusion/posterior",
)

# By the architecture, OpenBLAS's names of two older cores.
CORES = {"x86_64": ("Nehalem", "Sandybridge"), "aarch64": ("ARMV8", "CORTEXA57")}

# Asked in a process of its own, since all of them read the environment once. Names of instructions are x86's.
PROBE = """
import json, numba, numpy, scipy.linalg, threadpoolctl
kernel = numba.njit("float64(float64[::1], float64[::1])", fastmath=True)(lambda a, b: (a * b + a).sum())
code = "".join(kernel.inspect_asm().values())
pools = threadpoolctl.threadpool_info()
print(json.dumps({
    "cores": sorted({pool["architecture"] for pool in pools if pool["internal_api"] == "openblas"}),
    "threads": sorted({pool["num_threads"] for pool in pools} | {numba.config.NUMBA_NUM_THREADS}),
    "wide": [name for name in ("ymm", "zmm", "vfmadd") if name in code],
}))
"""


@dataclass(frozen=True, kw_only=True)
class Processor:
    """One run's kernels; ``core`` is None where the architecture has no older ones here."""

    core: str | None
    threads: int
    tests: tuple[str, ...]

    def environment(self, cache: str) -> dict[str, str]:
        """Environment that makes the libraries take them."""
        threads = str(self.threads)
        # numba takes both names together; without features the generic processor has the architecture's first ones.
        own = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": cache}
        own |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), threads)
        if self.core is not None:
            own["OPENBLAS_CORETYPE"] = self.core
        # NumPy warns of features that the processor does not have, and warnings are errors in the tests.
        own["NPY_DISABLE_CPU_FEATURES"] = " ".join(np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))
        return os.environ | own


def processors() -> list[Processor]:
    """All numerical tests on one thread of the oldest core; those of threads on two of the other."""
    oldest, other = CORES.get(platform.machine(), (None, None))
    return [Processor(core=oldest, threads=1, tests=NUMERICAL), Processor(core=other, threads=2, tests=OF_THREADS)]


def refuse_unless_taken(processor: Processor, environment: dict[str, str]) -> None:
    """End when a library has kept the kernels of the processor that is here."""
    done = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    print(f"== {processor.core}, {processor.threads} threads: {found}", flush=True)
    wanted = [] if processor.core is None else [processor.core.lower()]
    if wanted and [core.lower() for core in found["cores"]] != wanted:
        sys.exit(f"OpenBLAS runs as {found['cores']}, not as {processor.core}")
    if max(found["threads"]) > processor.threads:  # a machine with one core may run fewer
        sys.exit(f"the libraries run {found['threads']} threads, not {processor.threads}")
    if found["wide"]:
        sys.exit(f"numba compiles for this processor: {', '.join(found['wide'])} in its code")


def main(arguments: list[str]) -> int:
    """Run the tests once for each processor; 1 when any of them fails."""
    status = 0
    with tempfile.TemporaryDirectory(prefix="rayfix-portable-") as cache:
        for processor in processors():
            environment = processor.environment(cache)
            refuse_unless_taken(processor, environment)
            chosen = arguments or ["--numprocesses", "auto", "--dist", "loadfile", *processor.tests]
            command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", *chosen]
            status |= subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode != 0
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
