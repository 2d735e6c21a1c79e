/** The viewer of a loaded site: drawing, panels, and what connects them. */

import { Vector3 } from "three";

import { ServiceError, type Api, type StreamState } from "./api";
import { h, replace } from "./dom";
import { add, dot, vec } from "./numeric";
import { explainFix, type ExplainedFix } from "./residuals";
import { Building } from "./scene/building";
import { Mixture } from "./scene/mixture";
import { Selection } from "./scene/selection";
import type { Stage } from "./scene/stage";
import { Stations } from "./scene/stations";
import { Targets } from "./scene/targets";
import { postingOf } from "./messages";
import { Store } from "./store";
import { theme } from "./theme";
import { isFixes, readFixes, type Recording } from "./recording";
import { Mirrors } from "./trace/mirrors";
import type { FixEvent, Mesh, Point, Site, TableInfo, Vec3 } from "./types";
import { Dialogs } from "./ui/dialogs";
import { FixPanel } from "./ui/fixpanel";
import { Inspector } from "./ui/inspector";
import { installKeys } from "./ui/keyboard";
import type { Layout, Mode } from "./ui/layout";
import { drawLegend } from "./ui/legend";
import { Player } from "./ui/player";
import { Rulers } from "./ui/rulers";
import { Simulator } from "./ui/simulator";
import { Notices } from "./ui/status";
import { TargetList } from "./ui/targetlist";
import { ViewPanel } from "./ui/viewpanel";

const CLICK = 5; // px that a click may move
const NEAR = 16; // px from a target that still mean it
const LEAST_WIDTH = 240; // px of the drawing beside an open panel that legend and rulers need
const LEAST_BETWEEN = 1000; // ms between posteriors of a stream

const STREAM_TEXT: Record<StreamState, string> = {
  live: "live",
  connecting: "connecting",
  absent: "no stream",
  refused: "no access",
};

export class Viewer {
  readonly store = new Store();
  private readonly mirrors: Mirrors;
  private readonly selection: Selection;
  private readonly targets: Targets;
  private readonly mixture: Mixture;
  private readonly inspector: Inspector;
  private readonly viewPanel: ViewPanel;
  private readonly fixPanel: FixPanel;
  private readonly simulator = new Simulator();
  private readonly player = new Player(this.store, () => this.playerChanged());
  private readonly dialogs: Dialogs;
  private readonly notices: Notices;
  private readonly ground: number;
  private explained: ExplainedFix | null = null;
  private stale = false;
  private mode: Mode = "fixes";
  private simulating = false;
  private seed = 1;
  private posteriorOf: FixEvent | null = null;
  private posteriorAt = 0;
  private abort = new AbortController();

  constructor(
    private readonly layout: Layout,
    readonly stage: Stage,
    private readonly site: Site,
    mesh: Mesh,
    private readonly api: Api | null,
  ) {
    stage.origin = mesh.origin;
    const building = new Building(mesh, stage.section);
    stage.setBounds(building.bounds);
    this.ground = building.bounds.min.z + mesh.origin[2];
    const extent = building.bounds.getSize(new Vector3());
    this.mirrors = new Mirrors(mesh, site.settings.open_materials);
    this.selection = new Selection(stage);
    this.targets = new Targets(stage, this.store);
    this.mixture = new Mixture(stage, site, this.mirrors);
    const stations = new Stations(stage, site.stations, 0.045 * Math.hypot(extent.x, extent.y));
    stage.world.add(building.group, stations.group, this.targets.group, this.selection.group, this.mixture.group);
    setTimeout(() => {
      building.addEdges(mesh);
      stage.invalidate();
    }, 0);

    this.dialogs = new Dialogs(document.body);
    this.notices = new Notices(layout.stage);
    this.viewPanel = new ViewPanel(stage, building, this.selection, this.targets);
    this.fixPanel = new FixPanel((p) => this.focus(p));
    this.inspector = new Inspector(api, site, this.mixture, (text) => this.notices.show(text, "error"));
    const list = new TargetList(this.store, this.emptyState());
    replace(layout.left, this.viewPanel.element, list.element);
    layout.site.textContent = site.table.site.name;
    document.title = `rayfix · ${site.table.site.name}`;
    let hadTracks = false;
    const legend = drawLegend(layout.legend, site.settings.max_reflections, () => this.store.hasTracks);
    this.store.onFix(() => {
      if (this.store.hasTracks === hadTracks) return;
      hadTracks = this.store.hasTracks;
      legend();
      this.inset();
    });

    const rulers = new Rulers(stage, layout.canvas, () => layout.insets(), site.table.site.north_deg);
    layout.labels.before(rulers.element);
    layout.legend.before(this.player.element);

    layout.docs.hidden = api === null;
    layout.buttons.simulate.hidden = !site.settings.simulation;
    layout.buttons.paste.hidden = api === null;
    layout.tabs.table.hidden = api === null;
    layout.buttons.simulate.addEventListener("click", () => this.simulate(!this.simulating));
    layout.buttons.paste.addEventListener("click", () => this.paste());
    layout.buttons.help.addEventListener("click", () => this.dialogs.help());
    layout.tabs.fixes.addEventListener("click", () => this.show("fixes"));
    layout.tabs.table.addEventListener("click", () => this.show("table"));
    layout.onInsets(() => this.inset());
    installKeys({
      view: (name) => this.viewPanel.show(name),
      toggle: (part) => this.viewPanel.toggle(part),
      section: () => this.viewPanel.toggleSection(),
      step: (by) => this.store.step(by),
      focus: () => this.focus(this.store.selected?.latest.fix.position ?? null),
      pause: () => (this.player.active ? this.player.toggle() : list.togglePause()),
      simulate: () => site.settings.simulation && this.simulate(!this.simulating),
      paste: () => this.paste(),
      mode: (mode) => (mode === "fixes" || api !== null) && this.show(mode),
      theme: () => theme.toggle(),
      help: () => this.dialogs.help(),
      escape: () => this.escape(),
      busy: () => this.dialogs.open,
    });
    this.listenToPointer(layout.canvas);
    this.listenToDrops();

    this.store.onFix((target) => {
      this.stale ||= target === null || target === this.store.selected;
      if (this.stale) stage.invalidateLater();
    });
    this.store.onSelect(() => this.refresh());
    theme.onChange(() => this.describe());
    stage.onFrame(() => this.stale && this.explain());
    this.show("fixes");
    this.inset();
    stage.show("orbit");
    this.describe();
  }

  streamState(state: StreamState | "file"): void {
    const { connection } = this.layout;
    connection.className = state;
    connection.textContent = state === "file" ? "a file" : STREAM_TEXT[state];
  }

  /** Take in a fix of the stream, unless a log is shown. */
  receive(event: FixEvent): void {
    if (!this.player.active) this.store.add(event);
  }

  /** Show the fixes of a log, to be played. */
  play(recording: Recording): void {
    this.show("fixes");
    this.player.open(recording);
  }

  private playerChanged(): void {
    this.layout.stage.classList.toggle("playing", this.player.active);
    this.inset();
  }

  /** Let a person choose among the tables of the service, where there are several. */
  offerTables(tables: readonly TableInfo[]): void {
    if (tables.length < 2) return;
    const select = h("select", {
      "aria-label": "Table",
      onchange: () => {
        location.hash = new URLSearchParams({ table: select.value }).toString();
        location.reload();
      },
    });
    for (const { name } of tables) {
      select.append(h("option", { value: name, selected: name === this.site.table.name }, name));
    }
    replace(this.layout.site, select);
  }

  private emptyState(): HTMLElement {
    const ways = [
      this.api !== null && h("li", {}, "post reports to ", h("code", {}, "/v1/positions")),
      this.api !== null && h("li", {}, "paste or drop one here (V)"),
      this.site.settings.simulation && h("li", {}, "simulate one: S, then click a place"),
    ];
    return h("div", { className: "empty" }, h("p", {}, "No fixes yet."), h("ul", {}, ...ways));
  }

  private show(mode: Mode): void {
    this.mode = mode;
    for (const [name, tab] of Object.entries(this.layout.tabs)) tab.setAttribute("aria-selected", String(name === mode));
    const fixes = mode === "fixes";
    if (!fixes) this.simulate(false);
    replace(this.layout.right, ...(fixes ? [this.simulator.element, this.fixPanel.element] : [this.inspector.element]));
    this.selection.group.visible = fixes;
    this.targets.group.visible = fixes;
    this.layout.labels.classList.toggle("inspecting", !fixes);
    this.inspector.activate(!fixes);
    this.stage.invalidate();
  }

  /** Explain the selected fix with the next picture: a stream may bring several before. */
  private refresh(): void {
    this.stale = true;
    this.stage.invalidate();
  }

  private explain(): void {
    this.stale = false;
    const event = this.store.selected?.latest ?? null;
    const at = event?.fix.position ?? null;
    this.explained =
      event === null
        ? null
        : explainFix(this.mirrors, this.site, event.report, event.fix, at === null ? null : vec(at));
    this.selection.show(event, this.explained);
    this.describe();
    if (event !== null && event.posterior === undefined) void this.loadPosterior(event);
  }

  private describe(): void {
    const { selected } = this.store;
    this.fixPanel.show(selected?.latest ?? null, this.explained, selected?.track ?? null);
  }

  private async loadPosterior(event: FixEvent): Promise<void> {
    const live = event.source === "stream" || event.source === "log";
    const now = performance.now();
    if (this.api === null || event.fix.position === null || this.posteriorOf === event) return;
    if (event.report.measurements.length === 0) return;
    if (live && now - this.posteriorAt < LEAST_BETWEEN) return;
    this.posteriorOf = event;
    this.posteriorAt = now;
    this.abort.abort();
    this.abort = new AbortController();
    try {
      event.posterior = await this.api.posterior(event.report, this.abort.signal);
      if (this.store.selected?.id === (event.fix.target_id ?? this.store.selected?.id)) {
        this.selection.showPosterior(event.posterior);
      }
    } catch {
      // It is an addition to the picture; the fix stands without it.
    }
  }

  /** Tell the drawing, and what lies over it, how much the panels cover. */
  private inset(): void {
    const { left, right } = this.layout.insets();
    this.layout.stage.classList.toggle("covered", this.layout.stage.clientWidth - left - right < LEAST_WIDTH);
    const insets = this.layout.insets();
    this.stage.setInsets(insets);
    this.layout.stage.style.setProperty("--left", `${insets.left}px`);
    this.layout.stage.style.setProperty("--right", `${insets.right}px`);
  }

  private focus(p: Point | null): void {
    if (p !== null) this.stage.focus(this.stage.local(vec(p)));
  }

  private simulate(on: boolean): void {
    if (on && this.mode !== "fixes") this.show("fixes");
    this.simulating = on;
    this.simulator.element.hidden = !on;
    this.layout.buttons.simulate.setAttribute("aria-pressed", String(on));
    this.layout.canvas.classList.toggle("aiming", on);
    this.layout.hint.hidden = !on;
    this.layout.hint.textContent = "Click a place to simulate a report there. Esc ends.";
  }

  private paste(): void {
    if (this.api !== null) this.dialogs.paste((text) => this.take(text, "pasted fixes"));
  }

  /** Play the fixes of a log; locate anything else. */
  private async take(text: string, name: string): Promise<void> {
    if (isFixes(text)) this.play(readFixes(name, text));
    else if (this.api !== null) await this.locate(text);
    else throw new Error("This page has no service that locates reports; it plays fixes as rayfix locate -o writes them.");
  }

  /** Locate a report, a batch or another system's message given as text. */
  private async locate(text: string): Promise<void> {
    const { located, problems } = await this.api!.locate(postingOf(text));
    if (located.length) this.show("fixes");
    for (const { report, fix } of located) this.store.add({ report, fix, source: "posted" });
    if (problems.length) throw new Error(problems.slice(0, 5).join("\n"));
  }

  private async simulateAt(position: Vec3): Promise<void> {
    const options = { ...this.simulator.options(), seed: this.seed++, target_id: "simulated" };
    this.layout.hint.textContent = "Simulating …";
    try {
      const { report, fix } = await this.api!.simulate(position, options);
      this.store.add({ report, fix, source: "simulated", truth: position });
      this.layout.hint.textContent = "Click another place, or Esc to end.";
    } catch (error) {
      this.layout.hint.textContent = "Click another place, or Esc to end.";
      this.notices.show((error as ServiceError).message, "error");
    }
  }

  private escape(): void {
    if (this.dialogs.open) this.dialogs.close();
    else if (this.simulating) this.simulate(false);
    else this.store.select(null);
  }

  /** Place at the simulated height under a place of the canvas. */
  private placeUnder(x: number, y: number): Vec3 | null {
    const { origin, direction } = this.stage.rayAt(x, y);
    const height = this.ground + this.simulator.aboveGround;
    const t = (height - origin[2]) / dot(direction, [0, 0, 1]);
    return Number.isFinite(t) && t > 0 ? add(origin, direction, t) : null;
  }

  private listenToPointer(canvas: HTMLCanvasElement): void {
    let down: { x: number; y: number } | null = null;
    canvas.addEventListener("pointerdown", (e) => (down = e.button === 0 ? { x: e.offsetX, y: e.offsetY } : null));
    canvas.addEventListener("pointermove", (e) => {
      if (!this.simulating || e.buttons) return;
      const p = this.placeUnder(e.offsetX, e.offsetY);
      if (p !== null) this.layout.hint.textContent = `Simulate at ${p.map((v) => v.toFixed(2)).join(", ")} m`;
    });
    canvas.addEventListener("pointerup", (e) => {
      const start = down;
      down = null;
      if (start === null || Math.hypot(e.offsetX - start.x, e.offsetY - start.y) > CLICK) return;
      if (this.simulating) {
        const place = this.placeUnder(e.offsetX, e.offsetY);
        if (place !== null) void this.simulateAt(place);
      } else if (this.mode === "fixes") this.pick(e.offsetX, e.offsetY);
    });
  }

  /** Select the target near a place of the canvas. */
  private pick(x: number, y: number): void {
    const { clientWidth, clientHeight } = this.layout.canvas;
    let best: { id: string; apart: number } | null = null;
    for (const target of this.store.targets.values()) {
      for (const at of this.targets.positionsOf(target)) {
        const p = this.stage.local(at).project(this.stage.camera);
        const apart = Math.hypot(((p.x + 1) / 2) * clientWidth - x, ((1 - p.y) / 2) * clientHeight - y);
        if (apart < NEAR && (best === null || apart < best.apart)) best = { id: target.id, apart };
      }
    }
    if (best !== null) this.store.select(best.id);
  }

  private listenToDrops(): void {
    const { stage } = this.layout;
    const over = (on: boolean): void => void stage.classList.toggle("dropping", on);
    stage.addEventListener("dragover", (e) => (e.preventDefault(), over(true)));
    stage.addEventListener("dragleave", () => over(false));
    stage.addEventListener("drop", (e) => {
      e.preventDefault();
      over(false);
      void this.takeDropped(e.dataTransfer);
    });
  }

  private async takeDropped(data: DataTransfer | null): Promise<void> {
    const file = data?.files[0];
    const text = (await file?.text()) ?? data?.getData("text");
    if (!text) return;
    try {
      await this.take(text, file?.name ?? "dropped fixes");
    } catch (error) {
      this.notices.show((error as Error).message, "error");
    }
  }
}
