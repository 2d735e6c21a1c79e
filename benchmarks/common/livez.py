"""How long `/livez` takes at a service under attack and, at the same time, at one that does nothing else.

The machine has other work, which holds up any process: the second service shows how much of the waiting that is.
Both are asked from a process of its own, since what sends the attack holds up its own threads. As a program it takes
the file that the figures are shared in and the ports of both, and asks until its standard input ends.
"""

import http.client
import json
import math
import mmap
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PAUSE = 0.02
_PATIENCE = 60.0


@dataclass(frozen=True, kw_only=True)
class Waits:
    """What was measured.

    Attributes
    ----------
    attacked, idle : ndarray of shape (n,), s
        Waits for `/livez` of the service under attack and of the other; infinite where it did not answer.
    late : ndarray of shape (n,), s
        How late the thread that asks the first wakes from its pauses.
    """

    attacked: NDArray[np.float64]
    idle: NDArray[np.float64]
    late: NDArray[np.float64]

    def own_share(self, limit: float) -> float:
        """Share of the waits above a limit that is the service's own: that of the idle one is the machine's."""
        return max(0.0, float((self.attacked > limit).mean()) - float((self.idle > limit).mean()))

    def lines(self, limit: float) -> list[str]:
        """Write the figures side by side."""
        named = (("under attack", self.attacked), ("idle, at the same time", self.idle), ("pauses too long", self.late))
        return [
            f"  {name:23} {len(waits):7} times: median {1e3 * np.median(waits):5.1f} ms, "
            f"99.9 % {1e3 * np.quantile(waits, 0.999):5.0f} ms, at most {1e3 * waits.max():5.0f} ms, "
            f"{float((waits > limit).mean()):.4%} above {1e3 * limit:.0f} ms"
            for name, waits in named
        ]


class Livez:
    """Asks both services over and over until it is closed.

    Parameters
    ----------
    path : pathlib.Path
        File for the longest wait.
    attacked, idle : int
        Ports.
    """

    def __init__(self, path: Path, attacked: int, idle: int) -> None:
        self._longest = _shared(path)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.common.livez", str(path), str(attacked), str(idle)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def take(self) -> float:
        """Return the longest wait of the attacked service since the last call, s."""
        longest, self._longest[0] = self._longest[0], 0.0
        return longest

    def close(self) -> Waits:
        """End it and return what it measured."""
        output, _ = self._process.communicate(timeout=2 * _PATIENCE)
        return Waits(**{name: np.array(waits) for name, waits in json.loads(output).items()})


def _shared(path: Path) -> Any:
    if not path.exists():
        path.write_bytes(bytes(8))
    with path.open("r+b") as file:
        return memoryview(mmap.mmap(file.fileno(), 8)).cast("d")


class _Asker(threading.Thread):
    """Asks one service."""

    def __init__(self, port: int, end: threading.Event, longest: Any) -> None:
        super().__init__(daemon=True)
        self._port, self._end, self._longest = port, end, longest
        self.waits: list[float] = []
        self.late: list[float] = []

    def run(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=_PATIENCE)
        while not self._end.is_set():
            begin = time.perf_counter()
            time.sleep(_PAUSE)
            slept = time.perf_counter()
            self.late.append(slept - begin - _PAUSE)
            try:
                connection.request("GET", "/livez")
                ok = connection.getresponse().read() is not None
            except (OSError, http.client.HTTPException):
                connection.close()
                ok = False
            self.waits.append(time.perf_counter() - slept if ok else math.inf)
            self._longest[0] = max(self._longest[0], self.waits[-1])


def main() -> None:
    end = threading.Event()
    attacked = _Asker(int(sys.argv[2]), end, _shared(Path(sys.argv[1])))
    idle = _Asker(int(sys.argv[3]), end, [0.0])
    attacked.start()
    idle.start()
    sys.stdin.read()
    end.set()
    attacked.join()
    idle.join()
    print(json.dumps({"attacked": attacked.waits, "idle": idle.waits, "late": attacked.late}))


if __name__ == "__main__":
    main()
