/** Dialogs: a report from JSON, and the keys. */

import { h, replace } from "../dom";

const EXAMPLE = `{"target_id": "agv-7",
 "measurements": [
   {"type": "aoa", "station_id": "bs1", "azimuth_deg": 69.6, "zenith_deg": 96.3,
    "azimuth_stdev_deg": 1.0, "zenith_stdev_deg": 1.0},
   {"type": "pt", "station_id": "bs1", "range_m": 15.2, "stdev_m": 0.5}]}`;

const KEYS: readonly (readonly [string, string])[] = [
  ["1 2 3", "3D, plan, side"],
  ["Drag, right-drag, wheel", "turn, move, come nearer"],
  ["Arrows", "move, with the drawing focused"],
  ["C W O", "hide or show ceiling, walls, objects"],
  ["X", "section"],
  ["J K", "next and previous target"],
  ["Enter", "look at the selected fix"],
  ["Space", "hold the stream, go on; play or halt a log"],
  ["S", "simulate: click a place"],
  ["V", "paste a report"],
  ["F I", "fixes, table inspector"],
  ["T", "dark or light"],
  ["Esc", "close, end simulating, select nothing"],
];

export class Dialogs {
  private readonly dialog = h("dialog", {});

  constructor(root: HTMLElement) {
    root.append(this.dialog);
    this.dialog.addEventListener("click", (event) => event.target === this.dialog && this.dialog.close());
  }

  get open(): boolean {
    return this.dialog.open;
  }

  close(): void {
    this.dialog.close();
  }

  /** Ask for a report; `locate` rejects with what is wrong with it. */
  paste(locate: (text: string) => Promise<void>): void {
    const text = h("textarea", { rows: 14, spellcheck: false, placeholder: EXAMPLE, "aria-label": "Report or message" });
    const problem = h("p", { className: "warning", role: "alert", hidden: true });
    const submit = h("button", { type: "submit", className: "primary" }, "Locate");
    const form = h(
      "form",
      {
        onsubmit: async (event: Event) => {
          event.preventDefault();
          submit.disabled = true;
          try {
            await locate(text.value);
            this.dialog.close();
          } catch (error) {
            problem.textContent = (error as Error).message;
            problem.hidden = false;
          }
          submit.disabled = false;
        },
      },
      h("h2", {}, "A report"),
      h("p", { className: "muted" }, "Paste a report as POST /v1/positions takes it, a batch, an NRPPa message, angles of Silicon Labs locators or lines " +
          "of u-blox anchors; or drop a file anywhere. Fixes of a log, as rayfix locate -o writes them, are played."),
      text,
      problem,
      h("div", { className: "actions" }, h("button", { type: "button", onclick: () => this.dialog.close() }, "Cancel"), submit),
    );
    replace(this.dialog, form);
    this.dialog.showModal();
    text.focus();
  }

  help(): void {
    const list = h("dl", { className: "keys" });
    for (const [key, meaning] of KEYS) list.append(h("dt", {}, key), h("dd", {}, meaning));
    const close = h("button", { type: "button", className: "primary", onclick: () => this.dialog.close() }, "Close");
    replace(this.dialog, h("h2", {}, "Keys"), list, h("div", { className: "actions" }, close));
    this.dialog.showModal();
  }
}
