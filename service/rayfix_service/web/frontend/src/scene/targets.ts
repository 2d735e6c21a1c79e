/** All targets: a dot each, its name, and the trail of where it was. */

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Group, Line, LineBasicMaterial, Vector3 } from "three";

import type { Store, Target } from "../store";
import { theme } from "../theme";
import type { Label } from "./labels";
import { Dots } from "./shapes";
import type { Stage } from "./stage";

const TRAIL = 120;

interface Drawn {
  label: Label;
  trail: Line<BufferGeometry, LineBasicMaterial>;
  length: number;
}

export class Targets {
  readonly group = new Group();
  private readonly dots = new Dots({ rim: 0.2, throughWalls: true });
  private readonly drawn = new Map<string, Drawn>();
  private stale = true;
  showTrails = true;
  showLabels = true;

  constructor(
    private readonly stage: Stage,
    private readonly store: Store,
  ) {
    this.group.add(this.dots);
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

  private refreshLater(): void {
    this.stale = true;
    this.stage.invalidateLater();
  }

  private update(): void {
    this.stale = false;
    const { palette } = theme;
    this.dots.setRim(palette.background);
    const dots = [];
    for (const target of this.store.targets.values()) {
      const drawn = this.drawn.get(target.id) ?? this.make(target);
      const selected = this.store.selected === target;
      const at = target.trail[target.trail.length - 1];
      drawn.label.visible = at !== undefined && (this.showLabels || selected);
      drawn.label.element.classList.toggle("selected", selected);
      if (at !== undefined) {
        const position = this.stage.local(at);
        drawn.label.position.copy(position);
        dots.push({ position, colour: palette.fix, diameter: selected ? 9 : 11 });
      }
      this.drawTrail(drawn, target, selected);
    }
    for (const [id, drawn] of this.drawn) {
      if (this.store.targets.has(id)) continue;
      this.stage.labels.remove(drawn.label);
      this.group.remove(drawn.trail);
      drawn.trail.geometry.dispose();
      drawn.trail.material.dispose();
      this.drawn.delete(id);
    }
    this.dots.set(dots);
  }

  private make(target: Target): Drawn {
    const geometry = new BufferGeometry();
    const positions = new BufferAttribute(new Float32Array(3 * TRAIL), 3).setUsage(DynamicDrawUsage);
    geometry.setAttribute("position", positions);
    const trail = new Line(geometry, new LineBasicMaterial({ transparent: true, depthWrite: false }));
    trail.frustumCulled = false;
    trail.renderOrder = 3;
    this.group.add(trail);
    const label = this.stage.labels.add(target.id, "target", new Vector3());
    label.element.addEventListener("click", () => this.store.select(target.id));
    const drawn = { label, trail, length: 0 };
    this.drawn.set(target.id, drawn);
    return drawn;
  }

  private drawTrail(drawn: Drawn, target: Target, selected: boolean): void {
    const { trail } = drawn;
    trail.visible = this.showTrails && target.trail.length > 1;
    if (!trail.visible) return;
    const points = target.trail.slice(-TRAIL);
    const positions = trail.geometry.getAttribute("position") as BufferAttribute;
    points.forEach((p, n) => positions.setXYZ(n, ...this.stage.local(p).toArray()));
    positions.needsUpdate = true;
    trail.geometry.setDrawRange(0, points.length);
    trail.material.color.set(theme.palette.fix);
    trail.material.opacity = selected ? 0.9 : 0.4;
  }
}
