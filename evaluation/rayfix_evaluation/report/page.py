"""The report as one HTML page that needs nothing but itself."""

from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from rayfix_evaluation.report.captions import length, share
from rayfix_evaluation.report.figures import Spec, study_of
from rayfix_evaluation.report.interactive import plotly_script
from rayfix_evaluation.report.style import inline_svg
from rayfix_evaluation.studies.evaluate import Evaluation
from rayfix_evaluation.studies.methods import METHODS

__all__ = ["render_page"]

Document = Mapping[str, Any]

_SECTIONS = (
    ("statements", "What the paper states, and what holds here"),
    ("site", "The site and the drops"),
    ("method", "From angles and times to a position"),
    ("noise", "Accuracy by noise"),
    ("methods", "Methods side by side"),
    ("calibration", "Stated and true uncertainty"),
    ("planning", "Over the floor"),
    ("arrays", "Where angles come from"),
    ("stress", "When things are wrong"),
    ("made", "How this was made"),
)

_METHOD_FIGURES = (
    "scene",
    "plane-points",
    "points-aoa",
    "mixture-aoa",
    "points-aoa-pt",
    "mixture-aoa-pt",
    "length-differences",
)


def render_page(
    evaluation: Evaluation, specs: Sequence[Spec], interactive: Mapping[str, str], figures: Path, command: str
) -> str:
    """Render the page.

    Parameters
    ----------
    interactive : mapping of str to str
        JSON of Plotly figures by the keys of figures.
    figures : Path
        Folder of the written SVGs.
    command : str
        That made the evaluation.
    """
    results = evaluation.results
    by_key = {spec.key: _figure(spec, interactive, figures) for spec in specs}
    bodies = {
        "statements": _statements(results),
        "site": _site(evaluation),
        "method": "<p>One report, step by step as the paper's method sees it. Turn the pictures with the mouse; a "
        "click in "
        "a legend hides or shows.</p>" + "".join(by_key[key] for key in _METHOD_FIGURES if key in by_key),
        "noise": _noise(results, by_key),
        "methods": _methods(evaluation, by_key),
        "calibration": _calibration(results) + by_key["calibration"],
        "planning": _planning(by_key),
        "arrays": _arrays(results) + by_key["antenna-arrays"],
        "stress": _stress(by_key, specs),
        "made": _made(results, command),
    }
    toc = "".join(_entry(key, title, bodies[key], specs) for key, title in _SECTIONS)
    sections = "".join(
        f'<section id="{key}"><h2>{escape(title)}</h2>{bodies[key]}</section>' for key, title in _SECTIONS
    )
    data = "".join(
        f'<script type="application/json" id="data-{key}">{_harmless(text)}</script>'
        for key, text in interactive.items()
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>rayfix in {escape(results['site'])}</title><style>{_asset('page.css')}</style></head><body>"
        f'<div class="layout"><nav aria-label="Contents"><ol>{toc}</ol><button id="scheme">light / dark</button></nav>'
        f"<main>{_head(evaluation)}{sections}</main></div>{data}"
        f"<script>{plotly_script()}</script><script>{_asset('page.js')}</script></body></html>\n"
    )


def _entry(key: str, title: str, body: str, specs: Sequence[Spec]) -> str:
    """Entry of the table of contents: a section and the figures in it."""
    inner = [spec for spec in specs if f'<figure id="{spec.key}"' in body]
    below = "".join(f'<li><a href="#{spec.key}">{escape(spec.title)}</a></li>' for spec in inner)
    return f'<li><a href="#{key}">{escape(title)}</a>{f"<ol>{below}</ol>" if below else ""}</li>'


def _harmless(text: str) -> str:
    """JSON that cannot end the script element it stands in."""
    return text.replace("</", "<\\/")


def _asset(name: str) -> str:
    return files("rayfix_evaluation.report").joinpath(name).read_text(encoding="utf-8")


def _figure(spec: Spec, interactive: Mapping[str, str], figures: Path) -> str:
    caption = f"<figcaption><b>{escape(spec.title)}.</b> {escape(spec.caption)}</figcaption>"
    if spec.key in interactive:
        picture = f'<div class="space" id="space-{spec.key}" data-figure="data-{spec.key}"></div>'
        still = f"<noscript>{inline_svg(figures / f'{spec.key}.svg')}</noscript>"
        return f'<figure id="{spec.key}">{picture}{still}{caption}</figure>'
    return f'<figure id="{spec.key}">{inline_svg(figures / f"{spec.key}.svg")}{caption}</figure>'


def _head(evaluation: Evaluation) -> str:
    results = evaluation.results
    base = study_of(results, "methods")["points"][0]
    ours, paper = base["methods"]["rayfix"], base["methods"]["paper"]
    ms = evaluation.timings["studies"]["methods"][base["label"]]
    tiles = [
        (f"{length(ours['p50'][0])} / {length(ours['p90'][0])}", "rayfix, 50th and 90th percentile of the error"),
        (f"{length(paper['p50'][0])} / {length(paper['p90'][0])}", "the paper's method online, the same drops"),
        (
            f"{length(base['bound']['p50'])} / {length(base['bound']['p90'])}",
            "position error bound, which knows every path",
        ),
        (
            f"{ms['rayfix']['median_ms']:.1f} ms",
            f"of processor time a fix, median; the paper's method {ms['paper']['median_ms']:.0f} ms",
        ),
    ]
    drops = results["drops"]
    return (
        f"<h1>How well rayfix locates in {escape(results['site'])}</h1>"
        f'<p class="lead">An evaluation on simulated measurements: {ours["drops"]} transmitters dropped at random, '
        f"{share(drops['line_of_sight'])} of the pairs of drop and station in line of sight, ground truth from an "
        "image-method solver that shares no code with the table. Figures of this page are of angles with 1 deg and "
        "propagation times with 0.5 m where nothing else is said.</p>"
        '<div class="tiles">'
        + "".join(f'<div class="tile"><strong>{escape(v)}</strong>{escape(t)}</div>' for v, t in tiles)
        + "</div>"
    )


def _statements(results: Document) -> str:
    items = []
    for s in results["statements"]:
        name = METHODS[s["method"]].label
        verdict = "holds" if s["holds"] else "does not hold"
        reason = f" {escape(s['reason'])}" if s["reason"] else ""
        items.append(
            f'<li class="{"" if s["holds"] else "not"}"><span class="verdict">{verdict}</span> {escape(s["claim"])} '
            f"<small>{escape(name)}: {escape(s['figures'])}.{reason}</small></li>"
        )
    return (
        "<p>The paper's figures are of its own clutter, which is unpublished, so its numbers cannot be met here; its "
        "statements can be checked, for its method and for rayfix.</p>"
        f'<ul class="claims">{"".join(items)}</ul>'
    )


def _site(evaluation: Evaluation) -> str:
    results, table = evaluation.results, evaluation.table
    drops = results["drops"]
    vertices = table.scene.vertices
    size = " x ".join(f"{v:.3g}" for v in vertices.max(axis=0) - vertices.min(axis=0))
    heard = ", ".join(f"{n} by {k}" for k, n in drops["by_stations"].items())
    propagation = table.site.document["propagation"]
    rows = [
        (
            "Scene",
            f"{size} m, {len(table.scene.faces):,} triangles, {table.scene.free_space.volume:,.0f} m3 of free space",
        ),
        (
            "Stations",
            ", ".join(f"{s.id} at ({', '.join(f'{v:g}' for v in s.position)}) m" for s in table.site.stations),
        ),
        ("Paths", f"up to {propagation['max_reflections']} reflections and {propagation['max_path_length_m']:g} m"),
        (
            "Drops",
            f"{drops['drawn']} uniform in the free space; heard by stations: {heard}; {drops['unheard']} are left out",
        ),
        ("Line of sight", f"in {share(drops['line_of_sight'])} of the pairs of a drop and a station that hears it"),
        ("Paths heard", f"{drops['paths_heard']:.1f} by a station of a drop, of which it reports the strongest"),
    ]
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows) + "</dl>"


def _noise(results: Document, by_key: Mapping[str, str]) -> str:
    groups: list[tuple[str, Sequence[Document]]] = [
        (study_of(results, key)["title"], study_of(results, key)["points"]) for key in ("cdf-aoa", "cdf-pt", "cdf-rpt")
    ]
    rows = []
    for title, points in groups:
        rows.append(f'<tr class="group"><td colspan="8">{escape(title)}</td></tr>')
        for point in points:
            ours, paper, bound = point["methods"]["rayfix"], point["methods"]["paper"], point["bound"]
            rows.append(
                f"<tr><td>{escape(point['label'])}</td>"
                f"{_cell(ours['p50'])}{_cell(ours['p90'])}{_cell(paper['p50'])}{_cell(paper['p90'])}"
                f"<td>{length(bound['p50'])}</td><td>{length(bound['p90'])}</td>"
                f"<td>{_number(ours['rms_error_over_bound'])}</td></tr>"
            )
    table = (
        '<div class="scroll"><table><caption>Percentiles of the error with bootstrap 95 % intervals, same drops. The '
        "last column is rayfix's root mean square error over that of the bound, of fixes within five bounds.</caption>"
        '<thead><tr><th></th><th colspan="2">rayfix</th><th colspan="2">paper\'s method</th><th colspan="2">bound</th>'
        f"<th>error /</th></tr><tr><th></th>{3 * '<th>50th</th><th>90th</th>'}"
        f"<th>bound</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )
    return by_key["cdf-aoa"] + f'<div class="pair">{by_key["cdf-pt"]}{by_key["cdf-rpt"]}</div>' + table


def _methods(evaluation: Evaluation, by_key: Mapping[str, str]) -> str:
    study = study_of(evaluation.results, "methods")
    timings = evaluation.timings["studies"]["methods"]
    used = [key for key in METHODS if any(key in point["methods"] for point in study["points"])]
    notes = "".join(f"<dt>{escape(METHODS[key].label)}</dt><dd>{escape(METHODS[key].note)}</dd>" for key in used)
    rows = []
    for point in study["points"]:
        rows.append(f'<tr class="group"><td colspan="8">{escape(point["label"])}</td></tr>')
        for key, method in point["methods"].items():
            rows.append(
                f'<tr class="{"ours" if key == "rayfix" else ""}"><td>{escape(METHODS[key].label)}</td>'
                f"{_cell(method['p50'])}{_cell(method['p90'])}<td>{length(method['p95'][0])}</td>"
                f"<td>{share(method['gross'])}</td><td>{share(method['unanswered'])}</td>"
                f"<td>{_number(method['rms_error_over_bound'])}</td>"
                f"<td>{_milliseconds(timings[point['label']][key]['median_ms'])}</td></tr>"
            )
        bound = point["bound"]
        rows.append(
            f"<tr><td>position error bound</td><td>{length(bound['p50'])}</td><td>{length(bound['p90'])}</td><td></td>"
            f"<td></td><td><small>open in {share(bound['open'])}</small></td><td></td><td></td></tr>"
        )
    table = (
        '<div class="scroll"><table><caption>The same drops and noise for all. Gross: more than a metre and five '
        "bounds off. Times are medians of one thread's processor time; other work on the machine lengthens them."
        "</caption>"
        "<thead><tr><th></th><th>50th</th><th>90th</th><th>95th</th><th>gross</th><th>no position</th>"
        f"<th>error /<br>bound</th><th>ms</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )
    return f"<dl>{notes}</dl>{by_key['methods-percentiles']}{by_key['methods-cdf']}{table}"


def _calibration(results: Document) -> str:
    rows = []
    for point in study_of(results, "methods")["points"]:
        for key, method in point["methods"].items():
            if method["coverage"]:
                cells = "".join(f"<td>{share(v)}</td>" for v in method["coverage"].values())
                rows.append(f"<tr><td>{escape(METHODS[key].label)}, {escape(point['label'])}</td>{cells}</tr>")
    stated = next(
        m["coverage"] for p in study_of(results, "methods")["points"] for m in p["methods"].values() if m["coverage"]
    )
    heads = "".join(f"<th>{100 * float(p):.0f} %</th>" for p in stated)
    return (
        '<div class="scroll"><table><caption>Share of true positions within the credible ellipsoid of each stated '
        f"probability.</caption><thead><tr><th></th>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _planning(by_key: Mapping[str, str]) -> str:
    return (
        "<p>Everything above is of drops anywhere. Where fixes will be good and where not is foretold without a "
        "forward "
        "solver: the table says what each station would hear of a place, and the same table locates it.</p>"
        + by_key["planning"]
    )


def _arrays(results: Document) -> str:
    rows = []
    for array in results["antenna_arrays"]:
        rows.append(f'<tr class="group"><td colspan="7">{escape(array["label"])}, {array["snr_db"]:g} dB</td></tr>')
        for name, found in array["estimators"].items():
            statistics = found["statistics"]
            cells = [_number(found["p50_deg"]), _number(found["p90_deg"]), *(6 - 2) * [""]]
            if statistics is not None:
                report = statistics["report"]
                tails = (
                    f"{share(report['tail_share'])} x {report['tail_scale']:.1f}" if "tail_share" in report else "none"
                )
                cells[2:] = [
                    share(statistics["outlier_share"]),
                    f"{report['azimuth_stdev_deg']:.2f}",
                    f"{report['zenith_stdev_deg']:.2f}",
                    tails,
                ]
            rows.append(f"<tr><td>{escape(name)}</td>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    return (
        "<p>The paper lists four estimators as sources of angles, each with statistics of its own. These are theirs in "
        "this scene, in the form that a report states them: a deviation and, where errors have tails, the share and "
        "the "
        "width of a second, wider Gaussian. Angles off by more than a beam width are outliers, which rayfix expects, "
        "and "
        "are left out of the deviations.</p>"
        '<div class="scroll"><table><caption>Angle between the estimated direction and that of the strongest path, deg.'
        "</caption><thead><tr><th></th><th>50th</th><th>90th</th><th>outliers</th><th>azimuth<br>stdev</th>"
        f"<th>zenith<br>stdev</th><th>tails</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _stress(by_key: Mapping[str, str], specs: Sequence[Spec]) -> str:
    keys = [spec.key for spec in specs if spec.key.startswith("stress-")]
    return (
        "<p>Each curve changes one thing and leaves the rest: strongest paths, angles of 1 deg, times of 0.5 m, the "
        "twin "
        "as the building is. Solid lines and filled dots are medians, dashed lines and open dots 90th percentiles, "
        "bands and bars the bootstrap's 95 % intervals.</p>"
        f'<div class="pair">{"".join(by_key[key] for key in keys)}</div>'
    )


def _made(results: Document, command: str) -> str:
    rows = [
        ("Software", f"rayfix {results['software_version']}, code {results['code']}, Python {results['python']}"),
        ("Libraries", ", ".join(f"{name} {v}" for name, v in results["libraries"].items())),
        ("Table", results["table_id"]),
        ("Other tables", ", ".join(f"{name} {v[:12]}" for name, v in results["tables"].items() if name != "site")),
        ("Seed", str(results["seed"])),
        (
            "Effort",
            f"{results['effort']['name']}: {results['effort']['drops']} drops for each noise and method, "
            f"{results['effort']['stress_drops']} for each point of a curve"
            + (
                "; tables of other path priors have a finest window twice as wide"
                if results["effort"]["coarse"]
                else ""
            ),
        ),
    ]
    return (
        f"<pre>{escape(command)}</pre><dl>"
        + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows)
        + "</dl><p>The numbers are in <code>results.json</code> and <code>tables/*.csv</code>, the figures in "
        "<code>figures/</code>, times in <code>timings.json</code>. The same site, seed, table and version give the "
        "same "
        "<code>results.json</code>.</p>"
    )


def _cell(values: Sequence[float | None]) -> str:
    value, low, high = values
    return f"<td>{length(value)} <small>{_span(low, high)}</small></td>"


def _span(low: float | None, high: float | None) -> str:
    if low is None or high is None:
        return ""
    if high < 0.995:
        return f"{100 * low:.0f}&ndash;{100 * high:.0f}"
    return f"{low:.2f}&ndash;{high:.2f} m" if low < 0.995 else f"{low:.1f}&ndash;{high:.1f}"


def _number(value: float | None) -> str:
    return "&ndash;" if value is None else f"{value:.2f}"


def _milliseconds(value: float) -> str:
    return f"{value:.1f}" if value < 10 else f"{value:,.0f}"
