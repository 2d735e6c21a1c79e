/** The selected fix: where it may be, its rivals, and the paths that explain it. */

import { Group, Vector3 } from "three";
import type { Line2 } from "three/addons/lines/Line2.js";

import { vec } from "../numeric";
import type { ExplainedFix } from "../residuals";
import { theme } from "../theme";
import type { FixEvent, Posterior, Vec3 } from "../types";
import type { Label } from "./labels";
import { Dots, Ellipsoid, disposeLine, fatLine, type Dot } from "./shapes";
import type { Stage } from "./stage";

export const SIGMAS = 2;

export interface Shown {
  paths: boolean;
  rivals: boolean;
  cloud: boolean;
}

export class Selection {
  readonly group = new Group();
  readonly shown: Shown = { paths: true, rivals: true, cloud: true };
  private readonly cloud = new Dots({ opacity: 0.45, throughWalls: true });
  private readonly dots = new Dots({ rim: 0.25, throughWalls: true });
  private ellipsoids: Ellipsoid[] = [];
  private lines: Line2[] = [];
  private labels: Label[] = [];
  private event: FixEvent | null = null;
  private explained: ExplainedFix | null = null;
  private posterior: Posterior | null = null;

  constructor(private readonly stage: Stage) {
    this.group.add(this.cloud, this.dots);
    theme.onChange(() => this.draw());
  }

  show(event: FixEvent | null, explained: ExplainedFix | null): void {
    if (event !== this.event) this.posterior = event?.posterior ?? null;
    this.event = event;
    this.explained = explained;
    this.draw();
  }

  showPosterior(posterior: Posterior | null): void {
    this.posterior = posterior;
    this.draw();
  }

  draw(): void {
    this.clear();
    const { event, stage } = this;
    const { palette } = theme;
    const dots: Dot[] = [];
    if (event !== null) {
      event.fix.candidates.forEach((candidate, n) => {
        if (n > 0 && !this.shown.rivals) return;
        const at = stage.local(vec(candidate.position));
        const colour = n === 0 ? palette.fix : palette.rival;
        const strength = n === 0 ? 0.75 : 0.2 + 0.45 * candidate.probability;
        this.addEllipsoid(at, candidate.covariance_m2, colour, strength);
        if (n > 0) {
          dots.push({ position: at, colour, diameter: 8 });
          this.labels.push(stage.labels.add(percent(candidate.probability), "rival", at));
        }
      });
      if (event.truth) {
        const at = stage.local(event.truth);
        dots.push({ position: at, colour: palette.truth, diameter: 10 });
        this.labels.push(stage.labels.add("truth", "truth", at));
      }
    }
    if (this.shown.paths && this.explained !== null) this.addPaths(this.explained, dots);
    this.dots.setRim(palette.background);
    this.dots.set(dots);
    this.cloud.set(this.shown.cloud ? this.cloudDots() : []);
    stage.invalidate();
  }

  private cloudDots(): Dot[] {
    const colour = theme.palette.cloud;
    return (this.posterior?.samples ?? []).map((p: Vec3) => ({
      position: this.stage.local(p),
      colour,
      diameter: 3,
    }));
  }

  private addPaths(explained: ExplainedFix, dots: Dot[]): void {
    for (const path of explained.paths.values()) {
      const colour = theme.reflections(path.numReflections);
      const points = path.points.map((p) => this.stage.local(p));
      // Seen through walls faintly, and fully where nothing is before it.
      this.addLine(fatLine(points, colour, { width: 2.6, opacity: 0.5, throughWalls: true }));
      this.addLine(fatLine(points, colour, { width: 3.2 }));
      for (const point of points.slice(1, -1)) dots.push({ position: point, colour, diameter: 9 });
    }
  }

  private addLine(line: Line2): void {
    this.lines.push(line);
    this.group.add(line);
  }

  private addEllipsoid(
    at: Vector3,
    covariance: FixEvent["fix"]["candidates"][number]["covariance_m2"],
    colour: number,
    strength: number,
  ): void {
    for (const [through, opacity] of [
      [true, 0.35 * strength],
      [false, strength],
    ] as const) {
      const ellipsoid = new Ellipsoid();
      ellipsoid.place(at, covariance, SIGMAS);
      ellipsoid.paint(colour, opacity);
      ellipsoid.throughWalls(through);
      this.ellipsoids.push(ellipsoid);
      this.group.add(ellipsoid);
    }
  }

  private clear(): void {
    for (const ellipsoid of this.ellipsoids) {
      this.group.remove(ellipsoid);
      ellipsoid.dispose();
    }
    for (const line of this.lines) {
      this.group.remove(line);
      disposeLine(line);
    }
    for (const label of this.labels) this.stage.labels.remove(label);
    this.ellipsoids = [];
    this.lines = [];
    this.labels = [];
  }
}

export const percent = (p: number): string => (p > 0 && p < 0.01 ? "<1 %" : `${Math.round(100 * p)} %`);
