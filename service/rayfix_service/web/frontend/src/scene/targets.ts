/** All targets: a dot each, its name, and the trail of where it was; of its track the same, and the track's region. */

import { Group, Vector3 } from "three";

import { TRAIL, type Store, type Target } from "../store";
import { theme } from "../theme";
import type { Vec3 } from "../types";
import type { Label } from "./labels";
import { SIGMAS } from "./selection";
import { Dots, Ellipsoids, type Dot, type Shell } from "./shapes";
import type { Stage } from "./stage";
import { Trail } from "./trail";

interface Drawn {
  name: Label;
  fixes: Trail;
  state: Label;
  track: Trail;
  truth: Trail;
}

export class Targets {
  readonly group = new Group();
  readonly shown = { fixes: true, tracks: true, trails: true, names: true };
  private readonly dots = new Dots({ rim: 0.2, throughWalls: true });
  private readonly regions = new Ellipsoids();
  private readonly drawn = new Map<string, Drawn>();
  private stale = true;

  constructor(
    private readonly stage: Stage,
    private readonly store: Store,
  ) {
    this.group.add(this.dots, this.regions);
    store.onFix(() => this.refreshLater());
    store.onSelect(() => this.refresh());
    theme.onChange(() => this.refresh());
    // Twenty targets at 5 Hz are a hundred fixes a second, and fewer pictures.
    stage.onFrame(() => this.stale && this.update());
  }

  refresh(): void {
    this.stale = true;
    this.stage.invalidate();
  }

  /** Positions at which a target is drawn, m. */
  positionsOf(target: Target): Vec3[] {
    const fix = this.shown.fixes ? target.trail.slice(-1) : [];
    const track = this.shown.tracks ? (target.track?.trail.slice(-1) ?? []) : [];
    return [...fix, ...track];
  }

  private refreshLater(): void {
    this.stale = true;
    this.stage.invalidateLater();
  }

  private update(): void {
    this.stale = false;
    this.dots.setRim(theme.palette.background);
    const dots: Dot[] = [];
    const regions: Shell[] = [];
    for (const target of this.store.targets.values()) {
      const drawn = this.drawn.get(target.id) ?? this.make(target);
      this.drawFix(drawn, target, dots);
      this.drawTrack(drawn, target, dots, regions);
      this.drawTruth(drawn, target, dots);
    }
    for (const [id, drawn] of this.drawn) if (!this.store.targets.has(id)) this.forget(id, drawn);
    this.dots.set(dots);
    this.regions.set(regions);
  }

  private drawFix(drawn: Drawn, target: Target, dots: Dot[]): void {
    const { palette } = theme;
    const selected = this.store.selected === target;
    const points = this.shown.fixes ? target.trail.map((p) => this.stage.local(p)) : [];
    const at = points.at(-1);
    if (at !== undefined) dots.push({ position: at, colour: palette.fix, diameter: selected ? 9 : 11 });
    drawn.fixes.draw(this.shown.trails ? points : [], palette.fix, selected ? 0.9 : 0.4);
    // Where fixes are hidden or there is none, the name is at the track.
    const named = at ?? (this.shown.tracks ? this.localTrack(target).at(-1) : undefined);
    drawn.name.visible = named !== undefined && (this.shown.names || selected);
    if (named !== undefined) drawn.name.position.copy(named);
    drawn.name.element.classList.toggle("selected", selected);
  }

  private drawTrack(drawn: Drawn, target: Target, dots: Dot[], regions: Shell[]): void {
    const { palette } = theme;
    const selected = this.store.selected === target;
    const points = this.shown.tracks ? this.localTrack(target) : [];
    const at = points.at(-1);
    drawn.track.draw(this.shown.trails ? points : [], palette.track, selected ? 1 : 0.55);
    drawn.state.visible = at !== undefined && (selected || (this.shown.names && target.track!.latest.state !== "updated"));
    if (at === undefined) return;
    const { state, covariance_m2: covariance } = target.track!.latest;
    drawn.state.position.copy(at);
    drawn.state.element.textContent = `track ${state}`;
    dots.push({ position: at, colour: palette.track, diameter: selected ? 11 : 9 });
    const opacity = selected ? 0.5 : 0.25;
    regions.push({ mean: at, covariance, sigmas: SIGMAS, colour: palette.track, opacity, throughWalls: true });
  }

  private drawTruth(drawn: Drawn, target: Target, dots: Dot[]): void {
    const { palette } = theme;
    const points = this.shown.fixes ? target.truths.map((p) => this.stage.local(p)) : [];
    drawn.truth.draw(this.shown.trails ? points : [], palette.truth, this.store.selected === target ? 0.9 : 0.4);
    const at = points.at(-1);
    if (at !== undefined && target.latest.truth) dots.push({ position: at, colour: palette.truth, diameter: 9 });
  }

  private localTrack(target: Target): Vector3[] {
    return (target.track?.trail ?? []).map((p) => this.stage.local(p));
  }

  private make(target: Target): Drawn {
    const { labels } = this.stage;
    const drawn = {
      name: labels.add(target.id, "target", new Vector3()),
      fixes: new Trail(TRAIL),
      state: labels.add("", "track", new Vector3()),
      track: new Trail(TRAIL),
      truth: new Trail(TRAIL),
    };
    this.group.add(drawn.fixes, drawn.track, drawn.truth);
    drawn.name.element.addEventListener("click", () => this.store.select(target.id));
    this.drawn.set(target.id, drawn);
    return drawn;
  }

  private forget(id: string, drawn: Drawn): void {
    for (const label of [drawn.name, drawn.state]) this.stage.labels.remove(label);
    for (const trail of [drawn.fixes, drawn.track, drawn.truth]) {
      this.group.remove(trail);
      trail.dispose();
    }
    this.drawn.delete(id);
  }
}
