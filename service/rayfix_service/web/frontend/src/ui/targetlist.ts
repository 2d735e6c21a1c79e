/** The targets that were heard of, in a list. */

import { h, replace } from "../dom";
import { deviation } from "../rounding";
import type { Store, Target } from "../store";

const REFRESH = 250; // ms; more often would be for nobody's eyes

export class TargetList {
  readonly element = h("section", { className: "block targets" });
  private readonly list = h("ul", { role: "listbox", "aria-label": "Targets" });
  private readonly count = h("span", { className: "count" });
  private readonly pause = h("button", { type: "button", title: "Hold the stream (Space)", onclick: () => this.togglePause() }, "Pause");
  private readonly rows = new Map<string, HTMLLIElement>();
  private pending = 0;

  constructor(
    private readonly store: Store,
    private readonly empty: HTMLElement,
  ) {
    const clear = h("button", { type: "button", title: "Forget all targets", onclick: () => store.clear() }, "Clear");
    this.element.append(h("div", { className: "heading" }, h("h2", {}, "Targets"), this.count, this.pause, clear), empty, this.list);
    store.onFix(() => this.soon());
    store.onSelect(() => this.update());
    this.update();
  }

  togglePause(): void {
    this.store.paused = !this.store.paused;
    this.pause.textContent = this.store.paused ? "Go on" : "Pause";
    this.pause.setAttribute("aria-pressed", String(this.store.paused));
  }

  private soon(): void {
    if (this.pending) return;
    this.pending = window.setTimeout(() => this.update(), this.rows.size === this.store.targets.size ? REFRESH : 0);
  }

  private update(): void {
    window.clearTimeout(this.pending);
    this.pending = 0;
    const targets = this.store.ordered();
    this.empty.hidden = targets.length > 0;
    this.count.textContent = targets.length ? String(targets.length) : "";
    for (const id of this.rows.keys()) if (!this.store.targets.has(id)) this.rows.delete(id);
    const rows = targets.map((target) => this.row(target));
    const same = rows.length === this.list.childElementCount && rows.every((r, n) => this.list.children[n] === r);
    if (!same) replace(this.list, ...rows);
  }

  private row(target: Target): HTMLLIElement {
    let row = this.rows.get(target.id);
    if (row === undefined) {
      row = h("li", { role: "option", onclick: () => this.store.select(target.id) });
      this.rows.set(target.id, row);
    }
    const { fix } = target.latest;
    const accuracy = fix.horizontal_accuracy_m === null ? "no position" : `± ${deviation(fix.horizontal_accuracy_m)} m`;
    const track = target.track?.latest;
    row.setAttribute("aria-selected", String(this.store.selected === target));
    const tracked = track && `± ${deviation(track.horizontal_accuracy_m)} m`;
    const key = [fix.status, accuracy, track?.state, tracked].join(" ");
    if (row.dataset["key"] !== key) {
      row.dataset["key"] = key;
      replace(
        row,
        h("span", { className: `led ${fix.status}`, title: fix.status }),
        h("span", { className: "name" }, target.id),
        // A track knows more than the fix.
        track
          ? h("span", { className: "number", title: `track ${track.state}; fix ${accuracy}` }, h("small", {}, track.state), ` ${tracked}`)
          : h("span", { className: "number" }, accuracy),
      );
    }
    return row;
  }
}
