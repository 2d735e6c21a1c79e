/** The selected fix in numbers: position, rivals, and each measurement with what is left over of it. */

import { bar, h, replace, swatch } from "../dom";
import type { ExplainedFix, Residual } from "../residuals";
import type { Explanation } from "../trace/explain";
import { deviation } from "../rounding";
import { percent } from "../scene/selection";
import { hex, theme } from "../theme";
import type { TrackHistory } from "../tracks";
import type { Fix, FixEvent, Point } from "../types";
import { coordinates, fact, pointText, trackBlock } from "./trackblock";

const MEANING = {
  ok: "one place is likely",
  ambiguous: "several places are likely",
  inconsistent: "the measurements contradict the twin or each other",
  insufficient: "too little for a position",
} as const;

const SOURCES = { stream: "live", posted: "posted here", simulated: "simulated", file: "from the file", log: "from the log" } as const;

const KINDS: Record<string, string> = { aoa: "angle", pt: "range", toa: "arrival", path: "path", tdoa: "difference", rssi: "strength" };

/** Frames of angles, as docs/conventions.md names them. */
const FRAMES = {
  scene: "scene frame: azimuth counter-clockwise from +x, zenith from +z",
  lcs: "the station's own frame (LCS)",
  north: "azimuth counter-clockwise from north, zenith from +z",
} as const;
const FRAME_NAMES = { scene: "scene frame", lcs: "LCS", north: "from north" } as const;

const isTrusted = (fix: Fix): boolean => fix.status !== "inconsistent";

export class FixPanel {
  readonly element = h("section", { className: "block fix" });

  constructor(private readonly onFocus: (place: Point) => void) {}

  show(event: FixEvent | null, explained: ExplainedFix | null, track: TrackHistory | null): void {
    if (event === null) {
      replace(
        this.element,
        h("h2", {}, "Fix"),
        h("p", { className: "muted" }, "Select a target to see where it may be, and why."),
      );
      return;
    }
    const { fix } = event;
    replace(
      this.element,
      h(
        "div",
        { className: "heading" },
        h("h2", {}, fix.target_id ?? "(unnamed)"),
        h("span", { className: `chip ${fix.status}`, title: MEANING[fix.status] }, fix.status),
      ),
      h("p", { className: "muted" }, [MEANING[fix.status], SOURCES[event.source]].join(" · ")),
      fix.timestamp !== null && h("p", { className: "muted number stamp" }, fix.timestamp),
      fix.position === null ? h("p", {}, "No position.") : this.position(event),
      fix.warnings?.length ? h("ul", { className: "warnings" }, ...fix.warnings.map((text) => h("li", {}, text))) : null,
      track !== null && trackBlock(track.latest, fix.confidence, this.onFocus),
      isTrusted(fix) && fix.candidates.length > 1 && this.rivals(event),
      event.source === "log" && fix.measurements.length > event.report.measurements.length
        ? h("p", { className: "muted" }, "These fixes are without their reports; rayfix locate --with-reports writes both.")
        : this.measurements(explained),
    );
  }

  private position(event: FixEvent): HTMLElement {
    const { fix, truth } = event;
    const p = fix.position!;
    const error = truth && Math.hypot(p.x - truth[0], p.y - truth[1], p.z - truth[2]);
    return h(
      "div",
      {},
      coordinates(p, fix.covariance_m2, this.onFocus, "Look there (Enter)"),
      h(
        "dl",
        { className: "facts" },
        // Probabilities hold for measurements that the model is of, which those of an inconsistent fix are not.
        isTrusted(fix) &&
          fact("horizontal", `± ${deviation(fix.horizontal_accuracy_m!)} m`, `with a probability of ${percent(fix.confidence)}`),
        isTrusted(fix) &&
          fact("vertical", `± ${deviation(fix.vertical_accuracy_m!)} m`, `with a probability of ${percent(fix.confidence)}`),
        isTrusted(fix) && fact("held with", percent(fix.confidence), "probability that the target is within the accuracies"),
        fix.compute_ms !== undefined && error === undefined && fact("computed in", `${fix.compute_ms.toFixed(1)} ms`),
        error !== undefined && fact("true error", `${error.toFixed(2)} m`),
      ),
    );
  }

  private rivals(event: FixEvent): HTMLElement {
    const list = h("ul", { className: "candidates" });
    event.fix.candidates.slice(0, 8).forEach((candidate, n) => {
      const p = candidate.position;
      const apart = event.fix.position!;
      const distance = Math.hypot(p.x - apart.x, p.y - apart.y, p.z - apart.z);
      list.append(
        h(
          "li",
          { onclick: () => this.onFocus(p), title: `${pointText(p, candidate.covariance_m2)} m` },
          h("span", {}, n === 0 ? "this fix" : `rival ${n}`),
          bar(candidate.probability, n === 0 ? "best" : "rival"),
          h("span", { className: "number" }, percent(candidate.probability)),
          h("span", { className: "number muted" }, n === 0 ? "" : `${distance.toFixed(1)} m off`),
        ),
      );
    });
    return h("div", {}, h("h3", {}, "Where it may be"), list);
  }

  private measurements(explained: ExplainedFix | null): HTMLElement {
    const rows = h("tbody", {});
    for (const residual of explained?.residuals ?? []) rows.append(...this.row(residual));
    return h(
      "div",
      {},
      h("h3", {}, "Measurements, and how far off the twin is"),
      h("table", { className: "measurements" }, rows),
    );
  }

  private row(residual: Residual): HTMLElement[] {
    const { measurement: m, sigmas } = residual;
    const { path } = residual;
    const frame = m.type === "aoa" || m.type === "path" ? (m.frame ?? "scene") : undefined;
    const outlier = residual.outlierProbability ?? 0;
    const className = !residual.used ? "unused" : outlier > 0.5 ? "outlier" : "";
    const how = path ? wayOf(path) : "no path found";
    const station = m.reference_station_id ? `${m.station_id} − ${m.reference_station_id}` : m.station_id;
    const meter = h("span", { className: "meter", title: sigmas === null ? "" : `${sigmas.toFixed(1)} standard deviations` });
    if (sigmas !== null) {
      const pointer = h("span", { className: sigmas > 3 ? "far" : "" });
      pointer.style.width = `${Math.min(100, 25 * sigmas).toFixed(0)}%`;
      meter.append(pointer);
    }
    return [
      h(
        "tr",
        { className },
        h("th", { scope: "row" }, station, h("small", {}, KINDS[m.type] ?? m.type)),
        h("td", {}, ...lines(residual.text), h("small", { title: frame && FRAMES[frame] }, swatchOf(path?.numReflections), how, frame && ` · ${FRAME_NAMES[frame]}`)),
        h("td", { className: "left" }, ...(residual.difference.length ? lines(residual.difference) : ["–"]), meter),
      ),
      ...(!residual.used || outlier > 0.05
        ? [
            h(
              "tr",
              { className: `why ${className}` },
              h("td", { colSpan: 3 }, residual.used ? `outlier with a probability of ${percent(outlier)}` : `not used: ${residual.reason}`),
            ),
          ]
        : []),
    ];
  }
}

const lines = (texts: readonly string[]): HTMLElement[] => texts.map((text) => h("div", {}, text));

const swatchOf = (reflections: number | undefined): HTMLElement | null =>
  reflections === undefined ? null : swatch(hex(theme.reflections(reflections)));

/** What a path does on its way: reflections and walls. */
function wayOf({ numReflections, crossings }: Explanation): string {
  if (crossings.length === 0) return numReflections === 0 ? "direct" : `${numReflections} refl.`;
  const walls = `${crossings.length} wall${crossings.length === 1 ? "" : "s"}`;
  return numReflections === 0 ? `straight, ${walls}` : `${numReflections} refl., ${walls}`;
}
