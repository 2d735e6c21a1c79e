/** What the table inspector draws: the mixture of a direction, and the ray that it is of. */

import { Group } from "three";
import type { Line2 } from "three/addons/lines/Line2.js";

import { DEG, direction, vec } from "../numeric";
import { theme } from "../theme";
import type { Mirrors } from "../trace/mirrors";
import type { MixtureView, Site } from "../types";
import { Dots, Ellipsoid, disposeLine, fatLine, type Dot } from "./shapes";
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
  private readonly ellipsoids: Ellipsoid[] = [];
  private readonly dots = new Dots({ rim: 0.25, throughWalls: true });
  private lines: Line2[] = [];
  private last: [MixtureView | null, Aim] | null = null;

  constructor(
    private readonly stage: Stage,
    private readonly site: Site,
    private readonly mirrors: Mirrors,
  ) {
    this.group.add(this.dots);
    this.group.visible = false;
    theme.onChange(() => this.last && this.show(...this.last));
  }

  show(view: MixtureView | null, aim: Aim): void {
    this.last = [view, aim];
    this.drawRay(aim);
    const components = view?.components ?? [];
    const dots: Dot[] = [];
    const most = Math.max(...components.map((c) => c.probability), 1e-12);
    components.forEach((component, n) => {
      const at = this.stage.local(vec(component.position));
      const colour = theme.reflections(component.num_reflections);
      const share = Math.sqrt(component.probability / most);
      dots.push({ position: at, colour, diameter: 4 + 7 * share });
      if (n >= MOST) return;
      const ellipsoid = this.ellipsoids[n] ?? this.addEllipsoid();
      ellipsoid.visible = true;
      ellipsoid.place(at, component.covariance_m2, 1.5);
      ellipsoid.paint(colour, 0.05 + 0.75 * share);
    });
    for (let n = Math.min(components.length, MOST); n < this.ellipsoids.length; n++) this.ellipsoids[n]!.visible = false;
    this.dots.setRim(theme.palette.background);
    this.dots.set(dots);
    this.stage.invalidate();
  }

  private addEllipsoid(): Ellipsoid {
    const ellipsoid = new Ellipsoid();
    this.ellipsoids.push(ellipsoid);
    this.group.add(ellipsoid);
    return ellipsoid;
  }

  /** The ray of the measured direction itself, a colour for each number of reflections. */
  private drawRay(aim: Aim): void {
    for (const line of this.lines) {
      this.group.remove(line);
      disposeLine(line);
    }
    this.lines = [];
    const station = this.site.stations.find((s) => s.id === aim.stationId);
    if (station === undefined) return;
    const { max_reflections } = this.site.settings;
    const towards = direction(aim.azimuthDeg * DEG, aim.zenithDeg * DEG);
    const most = this.site.table.site.max_path_length_m;
    const { points } = this.mirrors.follow(vec(station.position), towards, max_reflections, most);
    for (let n = 0; n + 1 < points.length; n++) {
      const piece = [this.stage.local(points[n]!), this.stage.local(points[n + 1]!)];
      const line = fatLine(piece, theme.reflections(n), { width: 2, opacity: 0.8, throughWalls: true });
      this.lines.push(line);
      this.group.add(line);
    }
  }
}
