/** The table inspector: turn the measured angle of a station and watch its mixture. */

import { ServiceError, type Api } from "../api";
import { bar, h, replace, swatch } from "../dom";
import type { Aim, Mixture } from "../scene/mixture";
import { withDeviation } from "../rounding";
import { percent } from "../scene/selection";
import { hex, theme } from "../theme";
import type { Coverage, MixtureView, Site } from "../types";
import { pointText } from "./trackblock";

const SHOWN_COMPONENTS = 12;
const FRAME = "Angles are in the scene frame: azimuth counter-clockwise from +x, zenith from +z.";

export class Inspector {
  readonly element = h("section", { className: "block inspector" });
  readonly aim: Aim;
  private readonly facts = h("div", { className: "facts-area" });
  private readonly reach = h("div", {});
  private readonly sliders: Record<"azimuthDeg" | "zenithDeg" | "stdevDeg", HTMLInputElement>;
  private readonly outputs = { azimuthDeg: h("output", {}), zenithDeg: h("output", {}), stdevDeg: h("output", {}) };
  private readonly stations: HTMLSelectElement;
  private readonly coverages = new Map<string, Coverage>();
  private view: MixtureView | null = null;
  private underWay = false;
  private wanted = false;
  private active = false;

  constructor(
    private readonly api: Api | null,
    private readonly site: Site,
    private readonly mixture: Mixture,
    private readonly onError: (text: string) => void,
  ) {
    const first = site.stations[0]!;
    this.aim = { stationId: first.id, azimuthDeg: Math.round(first.boresight.azimuth_deg), zenithDeg: 97, stdevDeg: 1 };
    this.stations = h("select", { id: "inspected", onchange: () => this.choose(this.stations.value) });
    for (const station of site.stations) this.stations.append(h("option", { value: station.id }, station.id));
    const slider = (key: keyof Inspector["sliders"], min: number, max: number, step: number): HTMLInputElement =>
      h("input", {
        type: "range",
        id: key,
        min: String(min),
        max: String(max),
        step: String(step),
        oninput: () => {
          const value = Number(this.sliders[key].value);
          this.aim[key] = key === "stdevDeg" ? Number((10 ** value).toPrecision(2)) : value;
          this.refresh();
        },
      });
    this.sliders = {
      azimuthDeg: slider("azimuthDeg", -180, 180, 0.5),
      zenithDeg: slider("zenithDeg", 0, 180, 0.5),
      stdevDeg: slider("stdevDeg", -1, 1.4, 0.05),
    };
    const row = (name: string, key: keyof Inspector["sliders"]): HTMLElement[] => [
      h("label", { htmlFor: key }, name),
      this.sliders[key],
      this.outputs[key],
    ];
    this.element.append(
      h("h2", {}, "Table inspector"),
      h("p", { className: "muted" }, "Where can a signal come from that this station measures at this angle? ", FRAME),
      h(
        "div",
        { className: "rows three" },
        h("label", { htmlFor: "inspected" }, "Station"),
        this.stations,
        h("span", {}),
        ...row("Azimuth", "azimuthDeg"),
        ...row("Zenith", "zenithDeg"),
        ...row("Deviation", "stdevDeg"),
      ),
      this.facts,
      this.reach,
    );
    if (api === null) replace(this.facts, h("p", { className: "muted" }, "The table is with the service; this page has one fix of it."));
    theme.onChange(() => this.describe());
  }

  activate(active: boolean): void {
    this.active = active;
    this.mixture.group.visible = active;
    if (active) this.choose(this.aim.stationId);
  }

  choose(stationId: string): void {
    this.aim.stationId = stationId;
    this.stations.value = stationId;
    this.refresh();
    void this.loadCoverage(stationId);
  }

  /** Ask for the mixture of the present angle; one request at a time, the latest angle last. */
  refresh(): void {
    const { azimuthDeg, zenithDeg, stdevDeg } = this.aim;
    this.sliders.azimuthDeg.value = String(azimuthDeg);
    this.sliders.zenithDeg.value = String(zenithDeg);
    this.sliders.stdevDeg.value = String(Math.log10(stdevDeg));
    this.outputs.azimuthDeg.textContent = `${azimuthDeg.toFixed(1)}°`;
    this.outputs.zenithDeg.textContent = `${zenithDeg.toFixed(1)}°`;
    this.outputs.stdevDeg.textContent = `${stdevDeg}°`;
    if (!this.active || this.api === null) return;
    this.wanted = true;
    if (!this.underWay) void this.load(this.api);
  }

  private async load(api: Api): Promise<void> {
    this.underWay = true;
    while (this.wanted) {
      this.wanted = false;
      const aim = { ...this.aim };
      try {
        const signal = new AbortController().signal;
        this.view = await api.mixture(aim.stationId, aim.azimuthDeg, aim.zenithDeg, aim.stdevDeg, signal);
        this.mixture.show(this.view, aim);
        this.describe();
      } catch (error) {
        this.onError(error instanceof ServiceError ? error.message : String(error));
      }
    }
    this.underWay = false;
  }

  private async loadCoverage(stationId: string): Promise<void> {
    if (this.api === null) return;
    try {
      const coverage = this.coverages.get(stationId) ?? (await this.api.coverage(stationId));
      this.coverages.set(stationId, coverage);
      if (this.aim.stationId === stationId) this.describe();
    } catch (error) {
      this.onError(error instanceof ServiceError ? error.message : String(error));
    }
  }

  private describe(): void {
    if (this.view !== null) this.describeView(this.view);
    const coverage = this.coverages.get(this.aim.stationId);
    if (coverage !== undefined) this.describeCoverage(coverage);
  }

  private describeView(view: MixtureView): void {
    const station = this.site.stations.find((s) => s.id === view.station_id)!;
    const cell = view.cells[0];
    const row = (name: string, value: string): HTMLElement => h("div", {}, h("dt", {}, name), h("dd", {}, value));
    const place =
      view.num_cells === 1 && cell
        ? `${cell.index} at azimuth ${cell.azimuth_deg.toFixed(1)}°, zenith ${cell.zenith_deg.toFixed(1)}°`
        : `${view.num_cells} cells summed`;
    replace(
      this.facts,
      h(
        "dl",
        { className: "facts" },
        row("level", `${view.level} of 0–${station.levels.length - 1}, window ${Number(view.window_deg.toPrecision(3))}°`),
        row("cell", place),
        row("components", String(view.num_components)),
      ),
      !view.in_field_of_view && h("p", { className: "warning" }, "Outside of the station's field of view."),
      view.num_components === 0
        ? h("p", { className: "muted" }, "No ray comes from there.")
        : h(
            "div",
            {},
            h("h3", {}, "This direction, by reflections"),
            shares(view.by_reflections),
            view.by_walls.length > 1 && h("h3", {}, "By walls passed"),
            view.by_walls.length > 1 && shares(view.by_walls, undefined, wallsPassed),
            this.components(view),
          ),
    );
  }

  private components(view: MixtureView): HTMLElement {
    const rows = h("tbody", {});
    for (const component of view.components.slice(0, SHOWN_COMPONENTS)) {
      const p = component.position;
      rows.append(
        h(
          "tr",
          {},
          h("td", {}, swatch(hex(theme.reflections(component.num_reflections))), percent(component.probability)),
          h("td", {}, pointText(p, component.covariance_m2)),
          h(
            "td",
            {},
            withDeviation(component.path_length_m, component.path_length_stdev_m, ""),
            component.num_walls > 0 && h("small", {}, ` ${wallsPassed(component.num_walls)}`),
          ),
        ),
      );
    }
    const head = h("thead", {}, h("tr", {}, h("th", {}, "share"), h("th", {}, "mean, m"), h("th", {}, "path, m")));
    const more = view.num_components - Math.min(SHOWN_COMPONENTS, view.components.length);
    return h(
      "div",
      {},
      h("h3", {}, "Components"),
      h("table", { className: "components" }, head, rows),
      more > 0 && h("p", { className: "muted" }, `and ${more} less probable ones`),
    );
  }

  private describeCoverage(coverage: Coverage): void {
    const straight = coverage.wall_coverage;
    replace(
      this.reach,
      h("h3", {}, "Free space that this station hears"),
      shares(steps(coverage.coverage), missing(coverage.coverage)),
      straight.length > 0 && h("h3", {}, "By straight paths through walls"),
      straight.length > 0 &&
        shares(steps(straight), missing(straight), (n) => (n === 0 ? "line of sight" : wallsPassed(n))),
    );
  }
}

const name = (n: number): string => (n === 0 ? "direct" : n === 1 ? "1 reflection" : `${n} reflections`);

const wallsPassed = (n: number): string => (n === 0 ? "no wall" : n === 1 ? "1 wall" : `${n} walls`);

/** Increments of cumulative shares. */
const steps = (shares: readonly number[]): number[] => shares.map((share, n) => share - (n > 0 ? shares[n - 1]! : 0));

/** What cumulative shares lack of all. */
const missing = (shares: readonly number[]): number => 1 - (shares[shares.length - 1] ?? 0);

/** Bars of shares by the number of reflections, or of what `named` says. */
function shares(values: readonly number[], rest?: number, named = name): HTMLElement {
  const list = h("ul", { className: "candidates shares" });
  values.forEach((share, n) => {
    const meter = bar(share);
    (meter.firstElementChild as HTMLElement).style.background = hex(theme.reflections(n));
    list.append(h("li", {}, h("span", {}, named(n)), meter, h("span", { className: "number" }, percent(share))));
  });
  if (rest !== undefined && rest > 0.005) {
    list.append(h("li", { className: "muted" }, h("span", {}, "not at all"), bar(rest), h("span", { className: "number" }, percent(rest))));
  }
  return list;
}
