/** What the table inspector draws: the mixture of a direction, and the ray that it is of. */

import { Group, Vector3 } from "three";

import { DEG, direction, sub, vec } from "../numeric";
import { theme } from "../theme";
import type { Mirrors } from "../trace/mirrors";
import type { MixtureView, Site } from "../types";
import { Dots, Ellipsoids, FatLines, type Dot, type FatLine, type Shell } from "./shapes";
import type { Stage } from "./stage";

const MOST = 48; // ellipsoids; the rest are dots

export interface Aim {
  stationId: string;
  azimuthDeg: number;
  zenithDeg: number;
  stdevDeg: number;
}

export class Mixture {
  readonly group = new Group();
  private readonly ellipsoids = new Ellipsoids();
  private readonly dots = new Dots({ rim: 0.25, throughWalls: true });
  private readonly lines = new FatLines();
  private last: [MixtureView | null, Aim] | null = null;

  constructor(
    private readonly stage: Stage,
    private readonly site: Site,
    private readonly mirrors: Mirrors,
  ) {
    this.group.add(this.dots, this.ellipsoids, this.lines);
    this.group.visible = false;
    theme.onChange(() => this.last && this.show(...this.last));
  }

  show(view: MixtureView | null, aim: Aim): void {
    this.last = [view, aim];
    this.drawRay(aim);
    const components = view?.components ?? [];
    const dots: Dot[] = [];
    const shells: Shell[] = [];
    const most = Math.max(...components.map((c) => c.probability), 1e-12);
    components.forEach((component, n) => {
      const mean = this.stage.local(vec(component.position));
      const colour = theme.reflections(component.num_reflections);
      const share = Math.sqrt(component.probability / most);
      dots.push({ position: mean, colour, diameter: 4 + 7 * share });
      const opacity = 0.05 + 0.75 * share;
      const covariance = component.covariance_m2;
      if (n < MOST) shells.push({ mean, covariance, sigmas: 1.5, colour, opacity, throughWalls: false });
    });
    this.ellipsoids.set(shells);
    this.dots.setRim(theme.palette.background);
    this.dots.set(dots);
    this.stage.invalidate();
  }

  /** The ray of the measured direction itself, a colour for each number of reflections. */
  private drawRay(aim: Aim): void {
    const station = this.site.stations.find((s) => s.id === aim.stationId);
    if (station === undefined) return;
    const { max_reflections } = this.site.settings;
    const towards = direction(aim.azimuthDeg * DEG, aim.zenithDeg * DEG);
    const most = this.site.table.site.max_path_length_m;
    const from = sub(vec(station.position), this.mirrors.origin);
    const { points } = this.mirrors.follow(from, towards, max_reflections, most);
    const lines: FatLine[] = [];
    for (let n = 0; n + 1 < points.length; n++) {
      const piece = [new Vector3(...points[n]!), new Vector3(...points[n + 1]!)];
      lines.push({ points: piece, colour: theme.reflections(n), width: 2, opacity: 0.8, throughWalls: true });
    }
    this.lines.set(lines);
  }
}
