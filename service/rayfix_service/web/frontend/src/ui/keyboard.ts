/** Keys; they are listed in the help dialog and in docs/viewer.md. */

import type { Part } from "../scene/building";
import type { ViewName } from "../scene/stage";
import type { Mode } from "./layout";

export interface Commands {
  view(name: ViewName): void;
  toggle(part: Part): void;
  section(): void;
  step(by: number): void;
  focus(): void;
  pause(): void;
  simulate(): void;
  paste(): void;
  mode(mode: Mode): void;
  theme(): void;
  help(): void;
  escape(): void;
  /** Whether a dialog has the keys. */
  busy(): boolean;
}

export function installKeys(commands: Commands): void {
  const keys: Record<string, () => void> = {
    "1": () => commands.view("orbit"),
    "2": () => commands.view("plan"),
    "3": () => commands.view("side"),
    c: () => commands.toggle("ceiling"),
    w: () => commands.toggle("walls"),
    o: () => commands.toggle("objects"),
    x: () => commands.section(),
    j: () => commands.step(1),
    k: () => commands.step(-1),
    enter: () => commands.focus(),
    " ": () => commands.pause(),
    s: () => commands.simulate(),
    v: () => commands.paste(),
    f: () => commands.mode("fixes"),
    i: () => commands.mode("table"),
    t: () => commands.theme(),
    "?": () => commands.help(),
  };
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") {
      commands.escape();
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey || commands.busy()) return;
    const target = event.target as HTMLElement;
    // Where one types or chooses, keys are the element's own.
    if (target.closest("input, textarea, select")) return;
    if (target.closest("button") && [" ", "Enter"].includes(event.key)) return;
    const command = keys[event.key.toLowerCase()];
    if (command === undefined) return;
    event.preventDefault();
    command();
  });
}
