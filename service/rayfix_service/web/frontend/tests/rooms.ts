/** Scenes of the tests, and numbers that are random but the same each time. */

import type { Mesh, Vec3 } from "../src/types";

/** Triangles of a box's six sides. */
const SIDES = [
  [0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], // x
  [0, 1, 5], [0, 5, 4], [2, 3, 7], [2, 7, 6], // y
  [0, 2, 6], [0, 6, 4], [1, 3, 7], [1, 7, 5], // z
] as const;

/** Corners of a box, in the order of their bits: x, y, z. */
function corners([x0, y0, z0]: Vec3, [x1, y1, z1]: Vec3): number[] {
  return [x0, x1].flatMap((x) => [y0, y1].flatMap((y) => [z0, z1].flatMap((z) => [x, y, z])));
}

/** A mesh of boxes, each from one corner to the opposite one. */
export function boxes(...ends: [Vec3, Vec3][]): Mesh {
  return {
    positions: new Float32Array(ends.flatMap(([low, high]) => corners(low, high))),
    origin: [0, 0, 0],
    groups: ends.map((_, n) => ({
      material: `material ${n}`,
      colour: [1, 1, 1],
      indices: new Uint32Array(SIDES.flatMap((side) => side.map((corner) => 8 * n + corner))),
    })),
  };
}

/** Numbers from 0 to 1 (mulberry32). */
export function random(seed: number): () => number {
  let state = seed;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

export const between = (draw: () => number, low: number, high: number): number => low + (high - low) * draw();

export function randomVector(draw: () => number, low = -1, high = 1): Vec3 {
  return [between(draw, low, high), between(draw, low, high), between(draw, low, high)];
}
