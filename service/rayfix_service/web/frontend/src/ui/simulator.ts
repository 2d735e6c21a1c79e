/** What is simulated when a place is clicked. */

import { h } from "../dom";

export interface SimulationOptions {
  kinds: string[];
  angle_stdev_deg: number;
  range_stdev_m: number;
}

const KINDS: readonly (readonly [string, string, boolean])[] = [
  ["aoa", "angles", true],
  ["pt", "propagation times", true],
  ["toa", "arrivals, unknown clock", false],
  ["tdoa", "time differences", false],
];

export class Simulator {
  readonly element = h("section", { className: "block simulator", hidden: true });
  private readonly height = h("input", { type: "number", value: "1.0", step: "0.1", id: "sim-height" });
  private readonly angle = h("input", { type: "number", value: "1", min: "0.1", max: "20", step: "0.1", id: "sim-angle" });
  private readonly range = h("input", { type: "number", value: "0.5", min: "0.05", max: "10", step: "0.05", id: "sim-range" });
  private readonly kinds = new Map<string, HTMLInputElement>();

  constructor() {
    const checks = h("div", { className: "checks wide" });
    for (const [kind, name, on] of KINDS) {
      const box = h("input", { type: "checkbox", checked: on });
      this.kinds.set(kind, box);
      checks.append(h("label", {}, box, name));
    }
    this.element.append(
      h("h2", {}, "Simulate"),
      h("p", { className: "muted" }, "Click a place in the building: its stations report what the table says, with noise."),
      checks,
      h(
        "div",
        { className: "rows" },
        h("label", { htmlFor: "sim-height" }, "Above ground, m"),
        this.height,
        h("label", { htmlFor: "sim-angle" }, "Angles, °"),
        this.angle,
        h("label", { htmlFor: "sim-range" }, "Ranges, m"),
        this.range,
      ),
    );
  }

  get aboveGround(): number {
    return Number(this.height.value) || 0;
  }

  options(): SimulationOptions {
    const kinds = [...this.kinds].filter(([, box]) => box.checked).map(([kind]) => kind);
    return {
      kinds: kinds.length ? kinds : ["aoa"],
      angle_stdev_deg: Number(this.angle.value) || 1,
      range_stdev_m: Number(this.range.value) || 0.5,
    };
  }
}
