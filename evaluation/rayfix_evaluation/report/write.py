"""``rayfix evaluate``: run the missing studies, then write figures, tables and the page."""

from dataclasses import replace
from pathlib import Path

from rayfix_evaluation.report.figures import figure_specs, interactive_figures, write_figures
from rayfix_evaluation.report.page import render_page
from rayfix_evaluation.report.tables import write_tables
from rayfix_evaluation.studies.catalogue import FULL, QUICK
from rayfix_evaluation.studies.evaluate import Evaluation, Progress, evaluate_site
from rayfix_evaluation.studies.store import write_json, write_text

__all__ = ["PAGE", "RESULTS", "TIMINGS", "run_evaluation", "write_report"]

PAGE, RESULTS, TIMINGS = "report.html", "results.json", "timings.json"


def run_evaluation(
    site_path: Path,
    folder: Path,
    *,
    table_path: Path | None = None,
    quick: bool = False,
    drops: int | None = None,
    seed: int = 2026,
    jobs: int = -1,
    progress: Progress = lambda stage, done, total: None,
) -> Evaluation:
    """Evaluate a site and write the report into a folder.

    Parameters
    ----------
    table_path : Path, optional
        The site's table; built by default.
    quick : bool
        Few drops and wider windows for tables of other path priors.
    drops : int, optional
        Number of drops of each study, instead of the defaults.
    seed : int
        Zero or more.
    jobs : int
        Processes; -1 for one per core.

    Raises
    ------
    RayfixError
        See :func:`rayfix_evaluation.studies.evaluate.evaluate_site`.
    """
    effort = QUICK if quick else FULL
    if drops is not None:
        effort = replace(effort, drops=drops, stress_drops=drops)
    found = evaluate_site(
        site_path, folder, effort=effort, table_path=table_path, seed=seed, jobs=jobs, progress=progress
    )
    command = " ".join(
        [
            f"rayfix evaluate {site_path} -o {folder}",
            *([f"--table {table_path}"] if table_path is not None else []),
            *(["--quick"] if quick else []),
            *([f"--drops {drops}"] if drops is not None else []),
            f"--seed {seed}",
        ]
    )
    write_report(found, folder, command=command, progress=progress)
    return found


def write_report(evaluation: Evaluation, folder: Path, *, command: str, progress: Progress) -> None:
    """Write ``report.html``, ``results.json``, ``timings.json``, ``figures`` and ``tables`` into a folder.

    Raises
    ------
    RayfixError
        When the folder cannot be written.
    """
    write_json(folder / RESULTS, evaluation.results)
    write_json(folder / TIMINGS, evaluation.timings)
    write_tables(evaluation.results, folder / "tables")
    specs = figure_specs(evaluation)
    write_figures(specs, folder / "figures", lambda done: progress("drawing figures", done, len(specs)))
    interactive = interactive_figures(specs, evaluation)
    write_text(folder / PAGE, render_page(evaluation, specs, interactive, folder / "figures", command))
