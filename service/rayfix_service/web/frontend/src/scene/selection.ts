/** The selected fix: where it may be, its rivals, and the paths that explain it. */

import { Group } from "three";

import { vec } from "../numeric";
import type { ExplainedFix } from "../residuals";
import { theme } from "../theme";
import type { FixEvent, Posterior, Vec3 } from "../types";
import type { Label } from "./labels";
import { Dots, Ellipsoids, FatLines, type Dot, type FatLine, type Shell } from "./shapes";
import type { Stage } from "./stage";

export const SIGMAS = 2;

export interface Shown {
  /** The fix itself, and with it all that is drawn of it. */
  fix: boolean;
  paths: boolean;
  rivals: boolean;
  cloud: boolean;
}

export class Selection {
  readonly group = new Group();
  readonly shown: Shown = { fix: true, paths: true, rivals: true, cloud: true };
  private readonly cloud = new Dots({ opacity: 0.45, throughWalls: true });
  private readonly dots = new Dots({ rim: 0.25, throughWalls: true });
  private readonly ellipsoids = new Ellipsoids();
  private readonly lines = new FatLines();
  private labels: Label[] = [];
  private event: FixEvent | null = null;
  private explained: ExplainedFix | null = null;
  private posterior: Posterior | null = null;

  constructor(private readonly stage: Stage) {
    this.group.add(this.cloud, this.dots, this.ellipsoids, this.lines);
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
    for (const label of this.labels) this.stage.labels.remove(label);
    this.labels = [];
    const shells: Shell[] = [];
    const { event, stage } = this;
    const { palette } = theme;
    const dots: Dot[] = [];
    if (event !== null) {
      event.fix.candidates.forEach((candidate, n) => {
        if (!this.shown.fix) return;
        if (n > 0 && !this.shown.rivals) return;
        const at = stage.local(vec(candidate.position));
        const colour = n === 0 ? palette.fix : palette.rival;
        const strength = n === 0 ? 0.75 : 0.2 + 0.45 * candidate.probability;
        // Seen through walls faintly, and fully where nothing is before it.
        for (const [throughWalls, opacity] of [
          [true, 0.35 * strength],
          [false, strength],
        ] as const) {
          shells.push({ mean: at, covariance: candidate.covariance_m2, sigmas: SIGMAS, colour, opacity, throughWalls });
        }
        if (n > 0) {
          dots.push({ position: at, colour, diameter: 8 });
          // Of measurements that contradict each other, probabilities say nothing.
          const text = event.fix.status === "inconsistent" ? `rival ${n}` : percent(candidate.probability);
          this.labels.push(stage.labels.add(text, "rival", at));
        }
      });
      if (event.truth) {
        const at = stage.local(event.truth);
        dots.push({ position: at, colour: palette.truth, diameter: 10 });
        this.labels.push(stage.labels.add("truth", "truth", at));
      }
    }
    this.ellipsoids.set(shells);
    this.lines.set(this.shown.fix && this.shown.paths && this.explained !== null ? this.paths(this.explained, dots) : []);
    this.dots.setRim(palette.background);
    this.dots.set(dots);
    this.cloud.set(this.shown.fix && this.shown.cloud ? this.cloudDots() : []);
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

  private paths(explained: ExplainedFix, dots: Dot[]): FatLine[] {
    const lines: FatLine[] = [];
    for (const path of explained.paths.values()) {
      const colour = theme.reflections(path.numReflections);
      const points = path.points.map((p) => this.stage.local(p));
      lines.push({ points, colour, width: 2.6, opacity: 0.5, throughWalls: true });
      lines.push({ points, colour, width: 3.2, opacity: 1, throughWalls: false });
      for (const point of points.slice(1, -1)) dots.push({ position: point, colour, diameter: 9 });
      for (const crossing of path.crossings) dots.push({ position: this.stage.local(crossing), colour, diameter: 5 });
    }
    return lines;
  }
}

export const percent = (p: number): string => (p > 0 && p < 0.01 ? "<1 %" : `${Math.round(100 * p)} %`);
