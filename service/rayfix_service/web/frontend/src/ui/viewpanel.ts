/** How the twin is looked at: view, opacities, section, what is drawn. */

import { h } from "../dom";
import { PARTS, type Building, type Part } from "../scene/building";
import type { Selection } from "../scene/selection";
import { UNCUT, type Stage, type ViewName } from "../scene/stage";
import type { Targets } from "../scene/targets";

const VIEWS: Record<ViewName, string> = { orbit: "3D", plan: "Plan", side: "Side" };
const NAMES: Record<Part, string> = { floor: "Floor", walls: "Walls", ceiling: "Ceiling", objects: "Objects" };
const SEE_THROUGH: Record<Part, number> = { floor: 1, walls: 0.14, ceiling: 0.25, objects: 0.85 };

type Axis = "x" | "y" | "z";

export class ViewPanel {
  readonly element = h("section", { className: "block" });
  private readonly viewButtons = new Map<ViewName, HTMLButtonElement>();
  private readonly sliders = new Map<Part, HTMLInputElement>();
  private readonly position = h("input", { type: "range", min: "0", max: "1", step: "0.005", value: "0.5", "aria-label": "Place of the section" });
  private readonly place = h("output", {});
  private readonly on = h("input", { type: "checkbox", id: "section" });
  private axis: Axis = "z";
  private flipped = false;

  constructor(
    private readonly stage: Stage,
    private readonly building: Building,
    selection: Selection,
    targets: Targets,
  ) {
    const views = h("div", { className: "segments", role: "group", "aria-label": "View" });
    (Object.keys(VIEWS) as ViewName[]).forEach((name, n) => {
      const button = h("button", { type: "button", title: `${VIEWS[name]} view (${n + 1})`, onclick: () => this.show(name) }, VIEWS[name]);
      this.viewButtons.set(name, button);
      views.append(button);
    });
    this.element.append(h("h2", {}, "View"), views, this.opacities(), this.sectionControls());
    const toggles = h("div", { className: "checks" });
    const check = (name: string, initial: boolean, change: (on: boolean) => void): void => {
      const box = h("input", { type: "checkbox", checked: initial, onchange: () => change(box.checked) });
      toggles.append(h("label", {}, box, name));
    };
    check("Fixes", true, (v) => {
      selection.shown.fix = targets.shown.fixes = v;
      selection.draw();
      targets.refresh();
    });
    check("Tracks", true, (v) => ((targets.shown.tracks = v), targets.refresh()));
    check("Paths", true, (v) => ((selection.shown.paths = v), selection.draw()));
    check("Rivals", true, (v) => ((selection.shown.rivals = v), selection.draw()));
    check("Posterior", true, (v) => ((selection.shown.cloud = v), selection.draw()));
    check("Trails", true, (v) => ((targets.shown.trails = v), targets.refresh()));
    check("Names", true, (v) => ((targets.shown.names = v), targets.refresh()));
    this.element.append(toggles);
    this.mark();
  }

  show(view: ViewName): void {
    this.stage.show(view);
    this.mark();
  }

  /** Hide a part, or bring it back. */
  toggle(part: Part): void {
    this.set(part, this.building.getOpacity(part) > 0.01 ? 0 : SEE_THROUGH[part]);
  }

  toggleSection(): void {
    this.on.checked = !this.on.checked;
    this.cut();
  }

  private mark(): void {
    for (const [name, button] of this.viewButtons) button.setAttribute("aria-pressed", String(name === this.stage.view));
  }

  private set(part: Part, value: number): void {
    this.sliders.get(part)!.value = String(value);
    this.building.setOpacity(part, value);
    this.stage.invalidate();
  }

  private opacities(): HTMLElement {
    const rows = h("div", { className: "rows" });
    for (const part of PARTS) {
      const slider = h("input", {
        type: "range",
        min: "0",
        max: "1",
        step: "0.01",
        value: String(this.building.getOpacity(part)),
        id: `opacity-${part}`,
        oninput: () => this.set(part, Number(slider.value)),
      });
      this.sliders.set(part, slider);
      rows.append(h("label", { htmlFor: slider.id }, NAMES[part]), slider);
    }
    return rows;
  }

  private sectionControls(): HTMLElement {
    const axes = h("select", {
      "aria-label": "Direction of the section",
      onchange: () => {
        this.axis = axes.value as Axis;
        this.cut();
      },
    });
    for (const axis of ["z", "x", "y"]) axes.append(h("option", { value: axis }, axis));
    const flip = h("button", { type: "button", title: "Show the other half", onclick: () => ((this.flipped = !this.flipped), this.cut()) }, "⇄");
    this.on.addEventListener("change", () => this.cut());
    this.position.addEventListener("input", () => {
      this.on.checked = true;
      this.cut();
    });
    return h(
      "div",
      { className: "section" },
      h("label", { title: "Cut the building open (X)" }, this.on, "Section"),
      axes,
      flip,
      this.place,
      this.position,
    );
  }

  private cut(): void {
    const { section, bounds, origin } = this.stage;
    const share = Number(this.position.value);
    const [low, high] = [bounds.min[this.axis], bounds.max[this.axis]];
    const at = low + share * (high - low);
    const sign = this.flipped ? 1 : -1;
    section.normal.set(0, 0, 0)[this.axis] = sign;
    section.constant = this.on.checked ? -sign * at : UNCUT;
    const offset = origin["xyz".indexOf(this.axis) as 0 | 1 | 2];
    this.place.textContent = this.on.checked ? `${(at + offset).toFixed(2)} m` : "";
    this.stage.invalidate();
  }
}
