"""Runs methods on the drops of cases; each process has one bench."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.baselines.fingerprints import RadioMap
from rayfix_evaluation.drops.accuracy import Drop, drop_positions, solver_of
from rayfix_evaluation.drops.stress import move_scene
from rayfix_evaluation.studies.cases import Case, World, in_view, simulate_case
from rayfix_evaluation.studies.methods import METHODS, Answer, Answering, Question, Tools
from rayfix_evaluation.studies.summary import COVERAGE, Run
from rayfix_evaluation.truth.forward import StationSolver
from rayfix_service.wire import parse_report
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table

__all__ = ["Bench", "BenchSettings"]

_PLACES, _SCENE, _METHOD = 0, 3, 9
_MARGIN = 0.12
"""Smallest distance of drops from solids, m: moved objects must not cover them."""


@dataclass(frozen=True, kw_only=True)
class BenchSettings:
    """Settings of a bench.

    Attributes
    ----------
    tables : mapping of str to Path
        Tables by variant.
    seed : int
    drops : int
        Number of positions that are drawn. Each case uses the first ones that are audible to a station.
    radio_map : RadioMap or None
        Map of the fingerprints, if they are among the methods.
    """

    tables: Mapping[str, Path]
    seed: int
    drops: int
    radio_map: RadioMap | None = None


class Bench:
    """Drops, their paths in each world, and the methods; each is made on first use."""

    def __init__(self, settings: BenchSettings) -> None:
        self.settings = settings
        self.table = Table.open(settings.tables["site"]).in_table_frame
        self._solvers: dict[World, dict[str, StationSolver]] = {}
        self._drops: dict[tuple[World, int], Drop] = {}
        self._methods: dict[str, Answering] = {}

    @property
    def tools(self) -> Tools:
        """Tools from which methods are made."""
        return Tools(tables=self.settings.tables, radio_map=self.settings.radio_map)

    @cached_property
    def places(self) -> NDArray[np.float64]:
        """Positions of all drops, shape (n, 3), m."""
        rng = np.random.default_rng([self.settings.seed, _PLACES])
        return drop_positions(self.table, self.settings.drops, rng, margin=_MARGIN)

    def drop(self, world: World, number: int) -> Drop:
        """Return a drop with all its paths in a world."""
        if (world, number) not in self._drops:
            solvers = self._solvers_of(world)
            found = {name: solver.paths(self.places[number]) for name, solver in solvers.items()}
            seen = {s.id: in_view(s, found[s.id]) for s in self.table.site.stations}
            heard = {name: paths for name, paths in seen.items() if len(paths)}
            self._drops[world, number] = Drop(position=self.places[number], paths=heard)
        return self._drops[world, number]

    def heard(self, numbers: Sequence[int]) -> list[int]:
        """Numbers of the drops that are audible to a station in a world that matches its twin."""
        return [n for n in numbers if self.drop(World(), n).paths]

    def run(self, case: Case, method: str, numbers: Sequence[int]) -> tuple[Run, NDArray[np.float64]]:
        """Locate drops by a method.

        Returns
        -------
        run : Run
        seconds : ndarray of shape (n,)
            Processor time of each answer; 0 without a report.
        """
        stations = self.table.site.stations
        answering = self._method(method)
        count = len(numbers)
        error, bound, seconds = np.full(count, np.inf), np.full(count, np.inf), np.zeros(count)
        hidden, heard = np.zeros(count, np.int64), np.zeros(count, np.int64)
        covered = np.zeros((count, len(COVERAGE)), np.bool_)
        for n, number in enumerate(numbers):
            drop = self.drop(case.world, number)
            simulated = simulate_case(case, drop, number, stations, self.settings.seed)
            bound[n], hidden[n] = simulated.bound, simulated.hidden
            heard[n] = len({m["station_id"] for m in simulated.report["measurements"]})
            if not simulated.report["measurements"]:
                continue
            question = Question(
                report=parse_report(simulated.report),
                truth=drop.position,
                rng=np.random.default_rng([self.settings.seed, _METHOD, number]),
            )
            begin = process_time()
            answer = _answer(answering, question)
            seconds[n] = process_time() - begin
            if answer.position is not None:
                error[n] = np.linalg.norm(answer.position - drop.position)
            if answer.covered is not None:
                covered[n] = answer.covered
        stated = covered if METHODS[method].calibrated else None
        return Run(error=error, bound=bound, hidden=hidden, heard=heard, covered=stated), seconds

    def _method(self, key: str) -> Answering:
        if key not in self._methods:
            self._methods[key] = METHODS[key].make(self.tools)
        return self._methods[key]

    def _solvers_of(self, world: World) -> dict[str, StationSolver]:
        if world not in self._solvers:
            stations, scene = self.table.site.stations, self.table.scene
            vertices = move_scene(
                scene.vertices,
                scene.faces,
                np.array([station.position for station in stations]),
                objects=world.objects,
                walls=world.walls,
                rng=np.random.default_rng([self.settings.seed, _SCENE]),
            )
            solver = solver_of(self.table, vertices)
            solver = replace(solver, max_reflections=solver.max_reflections + world.more_reflections)
            self._solvers[world] = {s.id: solver.station(np.array(s.position)) for s in stations}
        return self._solvers[world]


def _answer(answering: Answering, question: Question) -> Answer:
    try:
        return answering(question)
    except ReportError:  # the method does not support the report
        return Answer(position=None)
