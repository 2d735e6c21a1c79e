"""The first compilation of kernels is announced wherever it happens; later ones load them and say nothing."""

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import numba
import numpy as np
from rayfix_service.fusion.posterior.principal_axes import semi_axes
from rayfix_tables.gaussians.compilation import watch_compilation

watch_compilation()
watch_compilation()
numba.njit(lambda x: x + 1.0)(1.0)
print("own")
semi_axes(np.eye(3))
semi_axes(np.eye(3, dtype=np.float32))
"""


def test_the_first_compilation_is_announced_once(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    for expected in (1, 0):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, timeout=600, check=True
        )
        assert sum("compiling kernels, once" in line for line in done.stderr.splitlines()) == expected
