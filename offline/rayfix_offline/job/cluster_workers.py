"""The workers of a Dask scheduler; each is asked for its version before it gets work.

A worker without rayfix, or with another version, would fail each of its tasks, and a task that only such workers could
take would never start.
"""

import logging
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from distributed import Client

from rayfix_offline.job.plan import BUILD_VERSION
from rayfix_tables.errors import BuildError
from rayfix_tables.version import software_version

ANSWER_SECONDS = 60.0
"""Time in which a worker must return its version; it may have to import rayfix first."""

LEFT_SECONDS = 60.0
"""Time that a build waits for a worker when none is left; one may be restarting."""

_Version = tuple[str, int]

# Text, which any worker can evaluate: a function of this package would need the package.
_ASK = (
    "(__import__('rayfix_tables.version', fromlist=['*']).software_version(), "
    "__import__('rayfix_offline.job.plan', fromlist=['*']).BUILD_VERSION)"
)

_log = logging.getLogger("rayfix")


class ClusterWorkers:
    """The workers that may take work.

    Parameters
    ----------
    client : distributed.Client
    address : str
        Of the scheduler, for messages.
    """

    def __init__(self, client: Client, address: str) -> None:
        self._client = client
        self._address = address
        self._known: dict[str, bool] = {}
        self._told: set[tuple[str, str]] = set()
        self._reason = ""
        self._none_since: float | None = None

    def fit(self) -> list[str] | None:
        """Return the addresses of the workers with this version, after asking those that are new.

        Returns
        -------
        list of str or None
            None if all workers may take work; workers that join later may take work too.

        Raises
        ------
        BuildError
            When there is none.
        """
        addresses = self._ask_new()
        fit = [address for address in addresses if self._known.get(address)]
        if not fit:
            raise self._error()
        return None if len(fit) == len(addresses) else fit

    def check_left(self) -> None:
        """Check that a worker is left; called at intervals while waiting for results.

        Raises
        ------
        BuildError
            When there has been none for some time.
        """
        if any(self._known.get(address) for address in self._ask_new()):
            self._none_since = None
            return
        now = time.monotonic()
        self._none_since = self._none_since or now
        if now - self._none_since >= LEFT_SECONDS:
            raise self._error()

    def _ask_new(self) -> list[str]:
        """Ask workers that are not yet known for their version; returns the addresses of all."""
        addresses = list(self._client.scheduler_info(n_workers=-1)["workers"])
        self._known = {address: is_fit for address, is_fit in self._known.items() if address in addresses}
        new = [address for address in addresses if address not in self._known]
        own = software_version(), BUILD_VERSION
        for address, answer in self._answers(new).items():
            if not isinstance(answer, OSError):  # otherwise it has just left or is busy, and is asked again
                self._known[address] = answer == own
            if answer != own:
                self._reason = _difference(answer, own)
                if (address, self._reason) not in self._told:
                    self._told.add((address, self._reason))
                    _log.warning("the worker %s gets no work: %s", address, self._reason)
        return addresses

    def _answers(self, addresses: list[str]) -> dict[str, Any]:
        """Return each worker's versions, or the exception that it raised."""
        if not addresses:
            return {}
        with ThreadPoolExecutor(len(addresses)) as pool:
            return dict(zip(addresses, pool.map(self._answer, addresses), strict=True))

    def _answer(self, address: str) -> Any:
        try:
            answers = self._client.run(
                eval, _ASK, workers=[address], on_error="return", callback_timeout=ANSWER_SECONDS
            )
        except OSError as error:  # TimeoutError is one
            return error
        return answers.get(address)

    def _error(self) -> BuildError:
        why = f" ({self._reason})" if self._reason else ""
        return BuildError(
            f"no worker with rayfix {software_version()} is left at {self._address}{why}; start some with 'dask worker "
            f"{self._address}' where it is installed; finished blocks are kept"
        )


def _difference(answer: Any, own: _Version) -> str:
    if isinstance(answer, ImportError):
        return f"it has no rayfix ({answer}); install rayfix {own[0]} there"
    if isinstance(answer, TimeoutError):
        return f"it has not returned its version within {ANSWER_SECONDS:.0f} s"
    if isinstance(answer, tuple | list) and len(answer) == 2:
        if answer[0] == own[0]:
            return f"its rayfix builds tables of version {answer[1]}, not {own[1]}; install the same there"
        return f"it has rayfix {answer[0]}, not {own[0]}; install that there"
    return f"it cannot determine its version ({answer!r}); install rayfix {own[0]} there"
