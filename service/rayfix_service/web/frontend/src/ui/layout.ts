/** The page's frame: bar, drawing, panels. */

import { h } from "../dom";
import { theme } from "../theme";

export type Mode = "fixes" | "table";

export interface Layout {
  canvas: HTMLCanvasElement;
  stage: HTMLElement;
  labels: HTMLElement;
  left: HTMLElement;
  right: HTMLElement;
  legend: HTMLElement;
  hint: HTMLElement;
  site: HTMLElement;
  connection: HTMLElement;
  docs: HTMLElement;
  tabs: Record<Mode, HTMLButtonElement>;
  buttons: Record<"simulate" | "paste" | "theme" | "help", HTMLButtonElement>;
  /** Space that the panels take from the drawing, px. */
  insets(): { left: number; right: number; top: number; bottom: number };
  onInsets(listener: () => void): void;
}

const PLAYER = 60; // px that the bar of a log takes
const NARROW = "(max-width: 1023px)";

export function buildLayout(root: HTMLElement): Layout {
  const canvas = h("canvas", {
    id: "canvas",
    tabIndex: 0,
    "aria-label": "The building in three dimensions. Drag to turn, right-drag to move, scroll to come nearer.",
  });
  const labels = h("div", { id: "labels" });
  const hint = h("div", { id: "hint", role: "status", hidden: true });
  const legend = h("div", { id: "legend" });
  const stage = h("main", { id: "stage" }, canvas, labels, hint, legend);
  const left = h("aside", { id: "left", className: "panel", "aria-label": "View and targets" });
  const right = h("aside", { id: "right", className: "panel", "aria-label": "Details" });
  const site = h("span", { id: "site" });
  const connection = h("span", { id: "connection", role: "status" });
  const docs = h("a", { id: "docs", className: "button", href: "docs", title: "The HTTP interface" }, "API");
  const tab = (name: string, title: string): HTMLButtonElement =>
    h("button", { className: "tab", role: "tab", type: "button", title }, name);
  const tabs = { fixes: tab("Fixes", "Reports and their fixes (F)"), table: tab("Table", "Table inspector (I)") };
  const button = (name: string, title: string, id: string): HTMLButtonElement =>
    h("button", { id, type: "button", title, "aria-label": title }, name);
  const buttons = {
    simulate: button("Simulate", "Click a place, see its fix (S)", "simulate"),
    paste: button("Paste report", "Locate a report from JSON (V)", "paste"),
    theme: button("◐", "Dark or light (T)", "theme"),
    help: button("?", "Keys (?)", "help"),
  };
  const toggle = (panel: HTMLElement, name: string, id: string): HTMLButtonElement =>
    h(
      "button",
      {
        id,
        type: "button",
        className: "drawer",
        "aria-label": name,
        title: name,
        onclick: () => {
          panel.classList.toggle("open");
          // On a narrow screen there is room for one.
          if (panel.classList.contains("open") && matchMedia(NARROW).matches) (panel === left ? right : left).classList.remove("open");
          notify();
        },
      },
      "☰",
    );
  const bar = h(
    "header",
    { id: "bar" },
    toggle(left, "View and targets", "open-left"),
    h("span", { id: "brand" }, "rayfix"),
    site,
    h("nav", { role: "tablist", "aria-label": "Mode" }, tabs.fixes, tabs.table),
    connection,
    h("span", { className: "gap" }),
    buttons.simulate,
    buttons.paste,
    docs,
    buttons.theme,
    buttons.help,
    toggle(right, "Details", "open-right"),
  );
  root.replaceChildren(bar, stage, left, right);

  const listeners: (() => void)[] = [];
  const notify = (): void => listeners.forEach((listener) => listener());
  const media = matchMedia(NARROW);
  const arrange = (): void => {
    left.classList.toggle("open", !media.matches);
    right.classList.toggle("open", !media.matches);
    notify();
  };
  media.addEventListener("change", arrange);
  arrange();
  buttons.theme.addEventListener("click", () => theme.toggle());
  return {
    canvas,
    stage,
    labels,
    left,
    right,
    legend,
    hint,
    site,
    connection,
    docs,
    tabs,
    buttons,
    insets: () => ({
      left: left.classList.contains("open") ? left.offsetWidth : 0,
      right: right.classList.contains("open") ? right.offsetWidth : 0,
      top: bar.offsetHeight,
      bottom: legend.offsetHeight + (stage.classList.contains("playing") ? PLAYER : 8),
    }),
    onInsets: (listener) => listeners.push(listener),
  };
}
