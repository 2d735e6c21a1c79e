"""The engine that uses a Dask cluster.

A task contains only the indices of its cells. A worker receives site, scene and method once, by content hash, and
traces a station's rays for the first of its blocks. The result of a block is the same to the last bit on any worker
with the same kind of processor and the same libraries. If a worker is lost, Dask assigns its blocks to others.
"""

import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from typing import Any

import numpy as np
from distributed import Client, Future, wait
from numpy.typing import NDArray

from rayfix_offline.fit.cells import FittedCells, fit_cells, widen_cells
from rayfix_offline.job.cluster_workers import ClusterWorkers
from rayfix_offline.job.engine import FittedBlocks, Job
from rayfix_offline.job.local import LocalEngine
from rayfix_offline.job.method import Method
from rayfix_offline.job.plan import BUILD_VERSION, Block, StationPlan
from rayfix_offline.job.previous_table import FormerStation, KeptCells
from rayfix_offline.job.shards import content_key
from rayfix_offline.rays.trace import StationTrace, level_grid, trace_station
from rayfix_offline.scene.scene import Scene
from rayfix_offline.site import SiteFile, parse_site
from rayfix_offline.twin.twin import prepare_scene
from rayfix_tables.errors import BuildError
from rayfix_tables.level import Level

LOOK_SECONDS = 5.0
"""Time between two looks at the workers while no result comes."""

CONNECT_SECONDS = 15
"""Time-out of the connection to a scheduler, s."""

RETRIES = 5
"""Number of times that a block may be lost with its worker."""

TRACES_KEPT = 2
"""Number of stations whose rays a worker keeps in memory; blocks arrive station by station."""

_Inputs = tuple[dict[str, Any], Scene, Method]
_Task = tuple[Callable[..., dict[str, Any]], tuple[Any, ...]]

_traces: "OrderedDict[str, StationTrace]" = OrderedDict()
_lock = threading.Lock()


class Cluster:
    """A Dask scheduler's workers as a :class:`~rayfix_offline.job.engine.FittingEngine`. Use it as a context manager.

    Parameters
    ----------
    address : str
        E.g. ``tcp://10.0.0.5:8786``.

    Raises
    ------
    BuildError
        When no scheduler answers, or it has no workers with this version of rayfix.
    """

    def __init__(self, address: str, job: Job) -> None:
        try:
            self._client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise BuildError(
                f"no Dask scheduler answers at {address}; start one with 'dask scheduler' and give its address"
            ) from error
        if not self._client.scheduler_info()["workers"]:
            self._client.close()
            raise BuildError(f"the Dask scheduler at {address} has no workers; start some with 'dask worker {address}'")
        self._workers = ClusterWorkers(self._client, address)
        try:
            self._workers.fit()
        except BaseException:
            self._client.close()
            raise
        self._local = LocalEngine(job)
        self._inputs: _Inputs = (job.site.model_dump(mode="json"), job.twin.scene, job.method)
        self._inputs_id = content_key(self._inputs[0], job.twin.scene.sha256, job.method.identity())

    def __enter__(self) -> "Cluster":
        """Return the connection."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection; running tasks are abandoned."""
        self._client.close()

    def keep(self, plan: StationPlan, former: FormerStation) -> KeptCells:
        """Compare in this process, which traces both scenes."""
        return self._local.keep(plan, former)

    def launch(self, plan: StationPlan) -> dict[str, Any]:
        """Trace a station's rays on a worker, unless this process has traced them for a comparison.

        Raises
        ------
        BuildError
            When it fails.
        """
        if self._local.has_traced(plan):
            return self._local.launch(plan)
        ((_, arrays),) = self._run(plan, {"launch": (_launch_remotely, ())})
        return arrays

    def fit_blocks(self, plan: StationPlan, blocks: list[Block]) -> FittedBlocks:
        """Fit blocks of a station on all workers; they come back as they are ready.

        Raises
        ------
        BuildError
            When a block fails, or is lost with its worker too often.
        """
        by_name = {block.shard: block for block in blocks}
        tasks = {name: (_fit_remotely, (block.cells,)) for name, block in by_name.items()}
        for name, arrays in self._run(plan, tasks):
            yield by_name[name], FittedCells.from_arrays(arrays)

    def widen_blocks(
        self, plan: StationPlan, blocks: list[Block], finer: Level, finer_change: NDArray[np.float32]
    ) -> FittedBlocks:
        """Make blocks of a wide level on all workers; they come back as they are ready.

        Raises
        ------
        BuildError
            When a block fails, or is lost with its worker too often.
        """
        if not blocks:
            return
        by_name = {block.shard: block for block in blocks}
        with warnings.catch_warnings():
            # The finer level goes to the scheduler once and from there to each worker, of which Dask warns.
            warnings.simplefilter("ignore", UserWarning)
            source = self._client.submit(
                _hand_on,
                finer,
                finer_change,
                key=f"rayfix-{plan.part_id}-under-{blocks[0].level}",
                workers=self._workers.fit(),
            )
        tasks = {name: (_widen_remotely, (source, block.level, block.cells)) for name, block in by_name.items()}
        for name, arrays in self._run(plan, tasks):
            yield by_name[name], FittedCells.from_arrays(arrays)

    def _run(self, plan: StationPlan, tasks: Mapping[str, _Task]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Run tasks on the workers with this version.

        Raises
        ------
        BuildError
            When a task fails, or no worker is left.
        """
        fit = self._workers.fit()
        # A task returns the inputs, instead of scattered data, because Dask can repeat a task after a loss.
        inputs = self._client.submit(_hand_on, *self._inputs, key=f"rayfix-inputs-{self._inputs_id}", workers=fit)
        futures = {
            self._client.submit(
                run,
                (plan.part_id, BUILD_VERSION, plan.station.id),
                inputs,
                *arguments,
                key=f"rayfix-{plan.part_id}-{name}-{_fingerprint(arguments)}",
                retries=RETRIES,
                workers=fit,
            ): name
            for name, (run, arguments) in tasks.items()
        }
        for future in self._as_completed(list(futures)):
            try:
                arrays = future.result()
            except BuildError:
                raise
            except Exception as error:  # any error of a worker
                raise BuildError(
                    f"station '{plan.station.id}' could not be built on the cluster: {error}; finished blocks are "
                    "kept, run the same build again to go on"
                ) from error
            yield futures[future], arrays
            future.release()

    def _as_completed(self, waiting: list[Future]) -> Iterator[Future]:
        """Futures as they are done; looks at the workers while none is."""
        while waiting:
            try:
                with self._client.as_current():
                    ready, rest = wait(waiting, timeout=LOOK_SECONDS, return_when="FIRST_COMPLETED")
            except TimeoutError:
                self._workers.check_left()
                continue
            except CancelledError as error:
                raise BuildError(
                    "the Dask scheduler has ended; finished blocks are kept, run the same build again to go on"
                ) from error
            yield from ready
            waiting = list(rest)


def _fingerprint(arguments: tuple[Any, ...]) -> str:
    """Distinguish tasks that fit different cells of one block."""
    return content_key([a.tolist() for a in arguments if isinstance(a, np.ndarray)])[:16]


def _hand_on(*inputs: Any) -> tuple[Any, ...]:
    """Return the inputs of many tasks, so that workers share them."""
    return inputs


def _fit_remotely(part: tuple[str, int, str], inputs: _Inputs, cells: NDArray[np.int64]) -> dict[str, Any]:
    """Fit a block on a worker."""
    site, scene, method = parse_site(inputs[0]), *inputs[1:]
    return fit_cells(cells, _trace(part, site, scene, method).finest, method.fit(site)).to_arrays()


def _widen_remotely(
    part: tuple[str, int, str],
    inputs: _Inputs,
    source: tuple[Level, NDArray[np.float32]],
    level: int,
    cells: NDArray[np.int64],
) -> dict[str, Any]:
    """Widen a block on a worker."""
    _check_version(part[1])
    method = inputs[2]
    window = float(np.deg2rad(parse_site(inputs[0]).table.windows_deg[level]))
    grid = level_grid(window, cells_per_window=method.rays.cells_per_window)
    return widen_cells(cells, window, grid, *source, method.wide).to_arrays()


def _launch_remotely(part: tuple[str, int, str], inputs: _Inputs) -> dict[str, Any]:
    """Trace a station's rays on a worker."""
    return _trace(part, parse_site(inputs[0]), *inputs[1:]).to_arrays()


def _trace(part: tuple[str, int, str], site: SiteFile, scene: Scene, method: Method) -> StationTrace:
    """Rays of a station, traced once on each worker."""
    part_id, version, station_id = part
    _check_version(version)
    with _lock:
        if part_id not in _traces:
            (section,) = [s for s in site.stations if s.id == station_id]
            twin = prepare_scene(site, scene, method.twin)
            _traces[part_id] = trace_station(section, site, twin, settings=method.rays, reflection=method.reflection)
            while len(_traces) > TRACES_KEPT:
                _traces.popitem(last=False)
        return _traces[part_id]


def _check_version(version: int) -> None:
    if version != BUILD_VERSION:
        raise BuildError(
            f"a worker builds tables of version {BUILD_VERSION}, this build needs {version}; install the same rayfix "
            "on all workers"
        )
