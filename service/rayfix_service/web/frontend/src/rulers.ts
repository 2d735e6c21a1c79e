/** What a view along an axis of the scene is measured with: ticks, a scale bar, the direction of north. */

import { DEG, direction, dot } from "./numeric";
import { fixed } from "./rounding";
import type { Vec3 } from "./types";

export const AXES = ["x", "y", "z"] as const;

/** A coordinate of the scene along an edge of the picture: start + perPixel * pixels. */
export interface ScreenAxis {
  axis: 0 | 1 | 2;
  /** m */
  start: number;
  /** m, negative where the coordinate falls */
  perPixel: number;
}

export interface Tick {
  pixel: number;
  text: string;
}

const SLACK = 1e-9; // of a step: so little is rounding

/** The largest of 1, 2, 5, 10, 20 ... that is at most a length. */
export function roundDown(length: number): number {
  const power = 10 ** Math.floor(Math.log10(length));
  const factor = [5, 2].find((one) => one * power <= length * (1 + SLACK)) ?? 1;
  return 10 * power <= length * (1 + SLACK) ? 10 * power : factor * power;
}

/** The smallest of those that is at least a length. */
export function roundUp(length: number): number {
  const down = roundDown(length);
  if (down >= length * (1 - SLACK)) return down;
  return [2, 5, 10].map((factor) => factor * 10 ** Math.floor(Math.log10(length))).find((one) => one >= length * (1 - SLACK))!;
}

/** Decimals that tell numbers apart which differ by a step. */
export const decimalsOfStep = (step: number): number => Math.max(0, Math.ceil(-Math.log10(step) - SLACK));

/** The axis that runs along an edge of the picture, given where the edge begins and the way of one pixel, m. */
export function screenAxis(start: Vec3, perPixel: Vec3): ScreenAxis {
  const sizes = perPixel.map(Math.abs);
  const axis = sizes.indexOf(Math.max(...sizes)) as 0 | 1 | 2;
  return { axis, start: start[axis], perPixel: perPixel[axis] };
}

/** Ticks at round coordinates between two pixels, at least `apart` pixels from each other. */
export function ticks({ start, perPixel }: ScreenAxis, from: number, to: number, apart: number): Tick[] {
  if (perPixel === 0 || to <= from) return [];
  const step = roundUp(Math.abs(perPixel) * apart);
  const ends = [start + perPixel * from, start + perPixel * to];
  const first = Math.ceil(Math.min(...ends) / step - SLACK);
  const last = Math.floor(Math.max(...ends) / step + SLACK);
  const decimals = decimalsOfStep(step);
  return Array.from({ length: last - first + 1 }, (_, n) => {
    const value = (first + n) * step;
    return { pixel: (value - start) / perPixel, text: fixed(value, decimals) };
  });
}

/** The longest round length of at most so many pixels. */
export function scaleBar(metresPerPixel: number, most: number): { pixels: number; text: string } {
  const metres = roundDown(metresPerPixel * most);
  return { pixels: metres / metresPerPixel, text: `${fixed(metres, decimalsOfStep(metres))} m` };
}

/**
 * Direction of north in a picture from above, degrees clockwise from up.
 *
 * `northDeg` is the site's, counter-clockwise from +x; `right` and `down` are the ways of one pixel in the scene.
 */
export function northOnScreen(northDeg: number, right: Vec3, down: Vec3): number {
  const north = direction(northDeg * DEG, 90 * DEG);
  return Math.atan2(dot(north, right), -dot(north, down)) / DEG;
}
