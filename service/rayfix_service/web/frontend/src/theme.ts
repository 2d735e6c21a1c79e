/** Dark and light: what the system prefers, unless the user chose. Colours of the drawing; style.css has the page's. */

import type { Vec3 } from "./types";

export type Theme = "dark" | "light";

export interface Palette {
  background: number;
  edges: number;
  edgeOpacity: number;
  /** Factor on the materials' colours. */
  tint: Vec3;
  floor: number;
  ink: number;
  fix: number;
  rival: number;
  truth: number;
  track: number;
  station: number;
  cloud: number;
  light: { sky: number; ground: number; ambient: number; sun: number };
}

const PALETTES: Record<Theme, Palette> = {
  dark: {
    background: 0x10141a,
    edges: 0x8fa3bd,
    edgeOpacity: 0.34,
    tint: [0.6, 0.67, 0.79],
    floor: 0x1c232d,
    ink: 0xe7ebf1,
    fix: 0xff5c77,
    rival: 0xffa24d,
    truth: 0x3ddc97,
    track: 0xf4f7fb,
    station: 0x7cc4ff,
    cloud: 0xff8fa3,
    light: { sky: 0xdfe9ff, ground: 0x39424f, ambient: 1.5, sun: 1.7 },
  },
  light: {
    background: 0xeef1f5,
    edges: 0x3c4858,
    edgeOpacity: 0.32,
    tint: [1.06, 1.08, 1.1],
    floor: 0xe2e6eb,
    ink: 0x1b222c,
    fix: 0xd81b4a,
    rival: 0xc96a00,
    truth: 0x0b8f5a,
    track: 0x1b222c,
    station: 0x1463b8,
    cloud: 0xd81b4a,
    light: { sky: 0xffffff, ground: 0xb9c2ce, ambient: 2.0, sun: 1.6 },
  },
};

/** Colours of 0, 1, 2, 3 and more reflections; they differ in lightness, too. */
const REFLECTIONS: Record<Theme, readonly number[]> = {
  dark: [0x4da3ff, 0x35d0ba, 0xffd166, 0xc792ff, 0xb0b7c3],
  light: [0x1667c7, 0x00877a, 0xa87400, 0x7e3fc4, 0x6b7480],
};

const STORED = "rayfix-theme";

class ThemeChoice {
  private listeners: (() => void)[] = [];
  private readonly system = matchMedia("(prefers-color-scheme: light)");
  private chosen: Theme | null = stored();

  constructor() {
    this.system.addEventListener("change", () => this.apply());
    this.apply();
  }

  get name(): Theme {
    return this.chosen ?? (this.system.matches ? "light" : "dark");
  }

  get palette(): Palette {
    return PALETTES[this.name];
  }

  reflections(count: number): number {
    const colours = REFLECTIONS[this.name];
    return colours[Math.min(count, colours.length - 1)]!;
  }

  toggle(): void {
    this.chosen = this.name === "dark" ? "light" : "dark";
    try {
      localStorage.setItem(STORED, this.chosen);
    } catch {
      // A page from a file may have no storage; the choice then lasts as long as the page.
    }
    this.apply();
  }

  onChange(listener: () => void): void {
    this.listeners.push(listener);
  }

  private apply(): void {
    document.documentElement.dataset["theme"] = this.name;
    for (const listener of this.listeners) listener();
  }
}

function stored(): Theme | null {
  try {
    const value = localStorage.getItem(STORED);
    return value === "dark" || value === "light" ? value : null;
  } catch {
    return null;
  }
}

export const theme = new ThemeChoice();

export const hex = (colour: number): string => `#${colour.toString(16).padStart(6, "0")}`;
