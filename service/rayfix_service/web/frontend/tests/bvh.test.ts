import { describe, expect, test } from "vitest";

import { cross, dot, sub, unit } from "../src/numeric";
import { Bvh, type Hit } from "../src/trace/bvh";
import type { Vec3 } from "../src/types";
import { random, randomVector } from "./rooms";

/** Triangles here and there in a cube. */
function scattered(count: number, draw: () => number): Float64Array {
  const corners: number[] = [];
  for (let n = 0; n < count; n++) {
    const centre = randomVector(draw, -5, 5);
    for (let k = 0; k < 3; k++) corners.push(...randomVector(draw).map((value, axis) => value + centre[axis]!));
  }
  return new Float64Array(corners);
}

/** The nearest triangle by trying all: the plane first, then the side of each edge. */
function tryAll(corners: Float64Array, origin: Vec3, direction: Vec3, least: number, most: number): Hit | null {
  let best: Hit | null = null;
  for (let n = 0; n < corners.length / 9; n++) {
    const [a, b, c] = [0, 3, 6].map((k) => [...corners.slice(9 * n + k, 9 * n + k + 3)] as unknown as Vec3) as [Vec3, Vec3, Vec3];
    const normal = cross(sub(b, a), sub(c, a));
    const distance = dot(sub(a, origin), normal) / dot(direction, normal);
    const point = origin.map((value, k) => value + distance * direction[k]!) as unknown as Vec3;
    const inside = ([[a, b], [b, c], [c, a]] as const).every(
      ([from, to]) => dot(cross(sub(to, from), sub(point, from)), normal) >= 0,
    );
    if (inside && distance > least && distance < most && (best === null || distance < best.distance)) {
      best = { distance, triangle: n };
    }
  }
  return best;
}

describe("a tree of boxes", () => {
  test.each([1, 4, 5, 60, 700])("of %i triangles finds what trying all finds", (count) => {
    const draw = random(count);
    const corners = scattered(count, draw);
    const tree = new Bvh(corners);
    expect(tree.count).toBe(count);
    let hits = 0;
    for (let n = 0; n < 300; n++) {
      const origin = randomVector(draw, -7, 7);
      // Towards a triangle's corners, mixed: most of these rays hit one, be it that or one before it.
      const at = 9 * Math.floor(draw() * count);
      const shares = [draw(), draw(), draw()];
      const aim = [0, 1, 2].map((k) => {
        const whole = shares[0]! + shares[1]! + shares[2]!;
        return shares.reduce((sum, share, corner) => sum + (share / whole) * corners[at + 3 * corner + k]!, 0);
      }) as unknown as Vec3;
      const direction = unit(sub(n % 2 ? aim : randomVector(draw, -5, 5), origin));
      const expected = tryAll(corners, origin, direction, 0, 100);
      const found = tree.cast(origin, direction, 0, 100);
      expect(found?.triangle).toBe(expected?.triangle);
      if (expected !== null) expect(found?.distance).toBeCloseTo(expected.distance, 9);
      hits += Number(expected !== null);
    }
    expect(hits).toBeGreaterThanOrEqual(150);
  });

  test("of nothing is hit by nothing", () => {
    expect(new Bvh(new Float64Array()).cast([0, 0, 0], [1, 0, 0], 0, 100)).toBeNull();
  });

  test("passes what is nearer than the least and farther than the most", () => {
    const walls = [1, 2, 3].flatMap((x) => [x, -1, -1, x, 3, -1, x, -1, 3]);
    const tree = new Bvh(new Float64Array(walls));
    const from: Vec3 = [0, 0, 0];
    expect(tree.cast(from, [1, 0, 0], 0, 10)).toEqual({ distance: 1, triangle: 0 });
    expect(tree.cast(from, [1, 0, 0], 1.5, 10)).toEqual({ distance: 2, triangle: 1 });
    expect(tree.cast(from, [1, 0, 0], 1.5, 1.9)).toBeNull();
    expect(tree.cast(from, [-1, 0, 0], 0, 10)).toBeNull();
  });

  test("is entered by a ray within the plane of its side", () => {
    // Both triangles lie in z = 0, and so does the ray's origin: the box has no height.
    const floor = [0, 0, 0, 4, 0, 0, 0, 4, 0, 4, 4, 0, 4, 0, 0, 0, 4, 0];
    const wall = [2, 0, -1, 2, 4, -1, 2, 0, 3];
    const tree = new Bvh(new Float64Array([...floor, ...wall]));
    expect(tree.cast([0, 1, 0], [1, 0, 0], 0, 10)).toEqual({ distance: 2, triangle: 2 });
  });

  test("of triangles with the same centre ends", () => {
    const same = Array.from({ length: 50 }, () => [1, -1, -1, 1, 3, -1, 1, -1, 3]).flat();
    expect(new Bvh(new Float64Array(same)).cast([0, 0, 0], [1, 0, 0], 0, 10)?.distance).toBe(1);
  });
});
