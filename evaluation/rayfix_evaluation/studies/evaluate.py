"""The whole evaluation of a site: tables, runs, pictures, and the document of results."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.baselines.fingerprints import simulate_map
from rayfix_evaluation.studies.arrays import study_arrays
from rayfix_evaluation.studies.bench import Bench, BenchSettings
from rayfix_evaluation.studies.cases import Case, World, document_key
from rayfix_evaluation.studies.catalogue import Effort, Study, studies
from rayfix_evaluation.studies.methods import METHODS
from rayfix_evaluation.studies.pictures import draw_pictures
from rayfix_evaluation.studies.planning import plan_site
from rayfix_evaluation.studies.pool import Task, run_tasks
from rayfix_evaluation.studies.statements import check_statements
from rayfix_evaluation.studies.store import Store, code_digest, not_written
from rayfix_evaluation.studies.summary import Run, percentile, summarise
from rayfix_evaluation.studies.variants import SITE, build_variants, open_site_table
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table
from rayfix_tables.version import software_version

__all__ = ["Evaluation", "Progress", "evaluate_site"]

Progress = Callable[[str, int, int], None]
"""Called with the stage, the amount of work done, and the total amount."""

_SPARE = 1.25
"""Candidate positions for each drop, because some are audible to no station."""

_LIBRARIES = ("numpy", "scipy", "numba", "scikit-learn", "embreex", "trimesh", "h5py")


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Result of an evaluation.

    Attributes
    ----------
    results : dict
        JSON-compatible data; equal for the same site, table, seed and version.
    timings : dict
        Processor time of answers, ms; varies between runs.
    pictures : dict
        Points, rays and mixtures of one report, for pictures.
    table : Table
    """

    results: dict[str, Any]
    timings: dict[str, Any]
    pictures: dict[str, Any]
    table: Table


def evaluate_site(
    site_path: Path,
    folder: Path,
    *,
    effort: Effort,
    table_path: Path | None = None,
    seed: int = 2026,
    jobs: int = -1,
    progress: Progress = lambda stage, done, total: None,
) -> Evaluation:
    """Run everything that is not yet stored in a folder, and summarise the results.

    Parameters
    ----------
    folder : Path
        Tables and finished runs are stored in its subfolder ``work``.
    table_path : Path, optional
        The site's table; it is built when left out.
    seed : int
        Zero or more. The same seed gives the same results.
    jobs : int
        Processes; -1 for one per core.

    Raises
    ------
    RayfixError
        When the site, its scene or the table cannot be used, no drop is audible to any station, or the folder cannot be
        written.
    """
    work = folder / "work"
    try:
        (work / "tables").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise not_written(work, error) from error
    site_table = open_site_table(site_path, table_path, work / "tables", jobs=jobs, progress=progress)
    opened = open_checked(site_table, whole=False)
    table = opened.in_table_frame  # fits of the other methods would lose digits on map coordinates
    planned = studies(
        effort,
        station_ids=[station.id for station in table.site.stations],
        reflections=int(table.site.document["propagation"]["max_reflections"]),
    )
    wanted = {METHODS[method].variant for study in planned for point in study.points for method in point.methods}
    names = sorted(wanted - {SITE})
    tables = {
        SITE: site_table,
        **build_variants(site_path, work / "tables", names, coarse=effort.coarse, jobs=jobs, progress=progress),
    }
    identities = {name: Table.open(path).table_id for name, path in tables.items()}
    most = max(study.drops for study in planned)
    settings = BenchSettings(tables=tables, seed=seed, drops=int(np.ceil(_SPARE * most)))
    runner = _Runner(
        settings=settings,
        identities=identities,
        store=Store(folder=work / "results"),
        spacing=effort.map_spacing,
        jobs=jobs,
        progress=progress,
    )
    drops = runner.drops()
    runner.run_all(planned, drops["heard"])
    array_drops = drops["heard"][: effort.array_drops]
    pictures = runner.stored("pictures", {}, lambda: draw_pictures(Bench(settings), drops["heard"], seed))
    results = {
        "format": "rayfix-evaluation",
        "site": table.site.name,
        "effort": asdict(effort),
        "seed": seed,
        "table_id": table.table_id,
        "origin_m": opened.scene.origin.tolist(),
        "tables": identities,
        "software_version": software_version(),
        "code": code_digest(),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
        "drops": {key: value for key, value in drops.items() if key != "heard"},
        "studies": [runner.study_document(study, drops["heard"]) for study in planned],
        "statements": [s.document() for s in check_statements(runner.runs(planned, drops["heard"]), seed)],
        "length_differences": pictures["length_differences"],
        "planning": runner.stored(
            "planning", {"spacing": effort.map_spacing}, lambda: plan_site(table, spacing=effort.map_spacing, seed=seed)
        ),
        "antenna_arrays": runner.stored(
            "antenna arrays", {"drops": array_drops}, lambda: _arrays(Bench(settings), array_drops, seed)
        ),
    }
    timings = {
        "cores": os.cpu_count(),
        "processes": jobs,
        "studies": {study.key: runner.timing_document(study, drops["heard"]) for study in planned},
    }
    return Evaluation(results=results, timings=timings, pictures=pictures, table=table)


def _arrays(bench: Bench, numbers: Sequence[int], seed: int) -> list[dict[str, Any]]:
    return study_arrays([bench.drop(World(), n) for n in numbers], bench.table.site.stations, seed=seed)


@dataclass(frozen=True, kw_only=True)
class _Runner:
    """Runs tasks without stored results."""

    settings: BenchSettings
    identities: Mapping[str, str]
    store: Store
    spacing: float
    jobs: int
    progress: Progress

    def stored(self, kind: str, details: Mapping[str, Any], compute: Callable[[], Any]) -> Any:
        """Return a stored result, or compute and store it."""
        key = self._key(kind, details, [SITE])
        content = self.store.get(key)
        if content is None:
            self.progress(kind, 0, 1)
            content = compute()
            self.store.put(key, content)
            self.progress(kind, 1, 1)
        return self.store.get(key)

    def drops(self) -> dict[str, Any]:
        """Numbers of the drops that are audible to a station, and their statistics.

        Raises
        ------
        RayfixError
            When no drop is audible to any station.
        """
        found: dict[str, Any] = self.stored("finding paths to drops", {}, self._find_drops)
        if not found["heard"]:
            raise RayfixError(
                f"none of {self.settings.drops} drops is audible to a station; check the stations' positions and "
                "max_path_length_m"
            )
        return found

    def _find_drops(self) -> dict[str, Any]:
        bench = Bench(self.settings)
        count = len(bench.places)
        heard = bench.heard(range(count))
        paths = [paths for n in heard for paths in bench.drop(World(), n).paths.values()]
        stations = np.bincount([len(bench.drop(World(), n).paths) for n in range(count)])
        return {
            "drawn": count,
            "heard": heard,
            "unheard": count - len(heard),
            "by_stations": {str(k): int(n) for k, n in enumerate(stations)},
            "line_of_sight": round(float(np.mean([bool(p.line_of_sight.any()) for p in paths])), 4) if paths else 0.0,
            "paths_heard": round(float(np.mean([len(p) for p in paths])), 2) if paths else 0.0,
        }

    def run_all(self, planned: Sequence[Study], heard: Sequence[int]) -> None:
        """Run the missing parts of all studies."""
        missing = [task for task in _tasks(planned, heard) if self.store.get(self._run_key(task)) is None]
        weights = [METHODS[task.method].weight for task in missing]
        total = round(sum(weight * len(task.drops) for weight, task in zip(weights, missing, strict=True)))
        done = 0.0

        def advance(method: str, count: int) -> None:
            nonlocal done
            done += METHODS[method].weight * count
            self.progress("locating drops", min(round(done), total), total)

        settings = self.settings
        if any(METHODS[task.method].needs_map for task in missing):
            self.progress("mapping fingerprints", 0, 1)
            settings = replace(
                settings, radio_map=simulate_map(Table.open(settings.tables[SITE]).in_table_frame, spacing=self.spacing)
            )
            self.progress("mapping fingerprints", 1, 1)
        for finished in run_tasks(settings, missing, jobs=self.jobs, advance=advance):
            content = {
                "run": finished.run.document(),
                "ms": [round(1e3 * float(s), 3) for s in finished.seconds],
            }
            self.store.put(self._run_key(finished.task), content)

    def runs(self, planned: Sequence[Study], heard: Sequence[int]) -> dict[tuple[str, str, str], Run]:
        """All runs, by study, point and method."""
        return {
            (study.key, point.label, method): Run.of_document(self._content(study, point.case, method, heard)["run"])
            for study in planned
            for point in study.points
            for method in point.methods
        }

    def study_document(self, study: Study, heard: Sequence[int]) -> dict[str, Any]:
        """Results of a study, without times."""
        points = []
        for point in study.points:
            methods = {}
            for method in point.methods:
                run = Run.of_document(self._content(study, point.case, method, heard)["run"])
                methods[method] = {**summarise(run, self.settings.seed), "error_m": run.document()["error_m"]}
            # The bound and the audible paths are the same for all methods of a point.
            points.append(
                {
                    "label": point.label,
                    "x": point.x,
                    "case": point.case.document(),
                    "bound": _bound_document(run),
                    "reflected_share": round(float(run.hidden.sum() / max(run.heard.sum(), 1)), 4),
                    "methods": methods,
                }
            )
        return {"key": study.key, "title": study.title, "axis": study.axis, "points": points}

    def timing_document(self, study: Study, heard: Sequence[int]) -> dict[str, dict[str, dict[str, float]]]:
        """Processor time of each point's methods, ms."""
        found: dict[str, dict[str, dict[str, float]]] = {}
        for point in study.points:
            found[point.label] = {}
            for method in point.methods:
                ms = np.array(self._content(study, point.case, method, heard)["ms"])
                found[point.label][method] = {
                    "median_ms": round(percentile(ms, 50), 3),
                    "p90_ms": round(percentile(ms, 90), 3),
                }
        return found

    def _content(self, study: Study, case: Case, method: str, heard: Sequence[int]) -> dict[str, Any]:
        content = self.store.get(self._run_key(_task(study, case, method, heard)))
        assert content is not None
        return dict(content)

    def _run_key(self, task: Task) -> dict[str, Any]:
        details = {
            "case": task.case.document(),
            "method": task.method,
            "drops": document_key({"numbers": list(task.drops)}),
        }
        return self._key("run", details, [SITE, METHODS[task.method].variant])

    def _key(self, kind: str, details: Mapping[str, Any], variants: Sequence[str]) -> dict[str, Any]:
        return {
            "kind": kind,
            "seed": self.settings.seed,
            "drawn": self.settings.drops,
            "map_spacing": self.spacing,
            "tables": sorted({self.identities[name] for name in variants}),
            "version": software_version(),
            "code": code_digest(),
            **details,
        }


def _tasks(planned: Sequence[Study], heard: Sequence[int]) -> list[Task]:
    """Tasks of all studies, without duplicates."""
    tasks = [
        _task(study, point.case, method, heard)
        for study in planned
        for point in study.points
        for method in point.methods
    ]
    return list(dict.fromkeys(tasks))


def _task(study: Study, case: Case, method: str, heard: Sequence[int]) -> Task:
    return Task(case=case, method=method, drops=tuple(heard[: study.drops]))


def _bound_document(run: Run) -> dict[str, Any]:
    def number(values: NDArray[np.float64], percent: float) -> float | None:
        value = percentile(values, percent)
        return round(value, 4) if np.isfinite(value) else None

    return {
        "p50": number(run.bound, 50),
        "p90": number(run.bound, 90),
        "open": round(float(np.mean(~np.isfinite(run.bound))), 4),
        "bound_m": run.document()["bound_m"],
    }
