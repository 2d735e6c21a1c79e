/** Over views from above and from the side: axes with coordinates, a scale bar, north, and where the pointer is. */

import { h, replace } from "../dom";
import { sub, scale } from "../numeric";
import { fixed } from "../rounding";
import { AXES, decimalsOfStep, northOnScreen, scaleBar, screenAxis, ticks, type ScreenAxis } from "../rulers";
import type { Stage } from "../scene/stage";
import type { Vec3 } from "../types";

const SVG = "http://www.w3.org/2000/svg";
const APART = { across: 90, down: 55 }; // px between ticks at least
const TICK = 6; // px
const LABEL = 16; // px below the lower axis
const BAR = 110; // px that the scale bar has at most

export interface Insets {
  left: number;
  right: number;
  top: number;
  bottom: number;
}

export class Rulers {
  readonly element: HTMLElement;
  private readonly drawing = document.createElementNS(SVG, "svg");
  private readonly bar = h("div", { id: "scale-bar" });
  private readonly north = document.createElementNS(SVG, "svg");
  private readonly cursor = h("output", { id: "cursor", "aria-label": "Coordinates under the pointer" });
  private pointer: { x: number; y: number } | null = null;
  private across: ScreenAxis | null = null;
  private down: ScreenAxis | null = null;

  constructor(
    private readonly stage: Stage,
    canvas: HTMLCanvasElement,
    private readonly insets: () => Insets,
    private readonly northDeg: number,
  ) {
    this.north.id = "north";
    this.north.setAttribute("viewBox", "-20 -20 40 40");
    this.north.setAttribute("role", "img");
    this.element = h("div", { id: "rulers", hidden: true }, this.drawing, this.bar, this.north, this.cursor);
    canvas.addEventListener("pointermove", (e) => this.point({ x: e.offsetX, y: e.offsetY }));
    canvas.addEventListener("pointerleave", () => this.point(null));
    stage.onFrame(() => this.draw());
  }

  private point(pointer: { x: number; y: number } | null): void {
    this.pointer = pointer;
    this.describePointer();
  }

  private draw(): void {
    const { stage } = this;
    this.element.hidden = stage.view === "orbit";
    if (this.element.hidden) return;
    stage.camera.updateMatrixWorld();
    const { width, height } = stage.extent;
    const corner = stage.rayAt(0, 0).origin;
    const perRight = scale(sub(stage.rayAt(width, 0).origin, corner), 1 / width);
    const perDown = scale(sub(stage.rayAt(0, height).origin, corner), 1 / height);
    this.across = screenAxis(corner, perRight);
    this.down = screenAxis(corner, perDown);
    const { left, right, top, bottom } = this.insets();
    const free = { left: left + 10, right: width - right - 10, top: top + 10, bottom: height - bottom - LABEL - 8 };
    this.drawAxes(free);
    this.drawBar(free, height);
    this.drawNorth(free, perRight, perDown);
    this.describePointer();
    this.cursor.style.right = `${width - free.right}px`;
    this.cursor.style.top = `${free.top}px`;
  }

  private drawAxes(free: Insets): void {
    const line = (x1: number, y1: number, x2: number, y2: number): Element => make("line", { x1, y1, x2, y2 });
    const text = (x: number, y: number, words: string, more: Record<string, string> = {}): Element => {
      const element = make("text", { x, y, ...more });
      element.textContent = words;
      return element;
    };
    const parts = [line(free.left, free.bottom, free.right, free.bottom), line(free.left, free.top, free.left, free.bottom)];
    // The ends are the names' own.
    for (const tick of ticks(this.across!, free.left + 24, free.right - 64, APART.across)) {
      parts.push(line(tick.pixel, free.bottom, tick.pixel, free.bottom - TICK));
      parts.push(text(tick.pixel, free.bottom + LABEL - 2, tick.text, { "text-anchor": "middle" }));
    }
    for (const tick of ticks(this.down!, free.top + 24, free.bottom - 44, APART.down)) {
      parts.push(line(free.left, tick.pixel, free.left + TICK, tick.pixel));
      parts.push(text(free.left + TICK + 4, tick.pixel + 4, tick.text));
    }
    const name = (axis: ScreenAxis): string => `${AXES[axis.axis]}, m`;
    parts.push(text(free.right, free.bottom + LABEL - 2, name(this.across!), { "text-anchor": "end", class: "name" }));
    parts.push(text(free.left + TICK, free.top + 10, name(this.down!), { class: "name" }));
    this.drawing.replaceChildren(...parts);
  }

  private drawBar(free: Insets, height: number): void {
    const { pixels, text } = scaleBar(Math.abs(this.across!.perPixel), BAR);
    this.bar.style.width = `${pixels.toFixed(1)}px`;
    this.bar.style.left = `${free.left + 14}px`;
    this.bar.style.bottom = `${height - free.bottom + 12}px`;
    replace(this.bar, text);
  }

  private drawNorth(free: Insets, perRight: Vec3, perDown: Vec3): void {
    this.north.toggleAttribute("hidden", this.stage.view !== "plan");
    if (this.stage.view !== "plan") return;
    const turn = northOnScreen(this.northDeg, perRight, perDown);
    this.north.setAttribute("aria-label", `North is ${turn.toFixed(0)}° clockwise from up`);
    const arrow = make("path", { d: "M0 -12 L5 6 L0 2 L-5 6 Z", transform: `rotate(${turn})` });
    const radians = (turn * Math.PI) / 180;
    const letter = make("text", { x: 16 * Math.sin(radians), y: 4 - 16 * Math.cos(radians), "text-anchor": "middle" });
    letter.textContent = "N";
    this.north.replaceChildren(arrow, letter);
    this.north.style.left = `${free.left + 52}px`;
    this.north.style.top = `${free.top}px`;
  }

  private describePointer(): void {
    const { across, down, pointer } = this;
    this.cursor.hidden = pointer === null || across === null || down === null || this.stage.view === "orbit";
    if (this.cursor.hidden) return;
    const known = [
      [across!, pointer!.x],
      [down!, pointer!.y],
    ] as const;
    // A pixel apart, the numbers differ.
    const decimals = decimalsOfStep(Math.abs(across!.perPixel));
    this.cursor.textContent = known
      .map(([{ axis, start, perPixel }, pixel]) => [axis, fixed(start + perPixel * pixel, decimals)] as const)
      .sort(([a], [b]) => a - b)
      .map(([axis, value]) => `${AXES[axis]} ${value}`)
      .join("  ")
      .concat(" m");
  }
}

function make(name: string, attributes: Record<string, string | number>): Element {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  return element;
}
