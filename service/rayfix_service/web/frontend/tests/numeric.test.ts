import { describe, expect, test } from "vitest";

import { DEG, add, anglesOf, cross, direction, dot, eigen, length, localToScene, multiply, scale, sub, transpose, unit, wrap } from "../src/numeric";
import type { Matrix3, Vec3 } from "../src/types";
import { between, random, randomVector } from "./rooms";

function near(found: readonly number[], expected: readonly number[], digits = 12): void {
  expect(found).toHaveLength(expected.length);
  expected.forEach((value, n) => expect(found[n]).toBeCloseTo(value, digits));
}

describe("vectors", () => {
  test("a cross product is perpendicular to both and as long as their parallelogram", () => {
    const draw = random(1);
    for (let n = 0; n < 50; n++) {
      const [a, b] = [randomVector(draw), randomVector(draw)];
      const c = cross(a, b);
      expect(dot(a, c)).toBeCloseTo(0, 12);
      expect(dot(b, c)).toBeCloseTo(0, 12);
      expect(dot(c, c)).toBeCloseTo(dot(a, a) * dot(b, b) - dot(a, b) ** 2, 12);
    }
    near(cross([1, 0, 0], [0, 1, 0]), [0, 0, 1]);
  });

  test("sums, differences and lengths", () => {
    near(add([1, 2, 3], [4, 5, 6], 2), [9, 12, 15]);
    near(sub([1, 2, 3], [4, 6, 8]), [-3, -4, -5]);
    expect(length([2, 3, 6])).toBe(7);
    near(unit([0, -3, 4]), [0, -0.6, 0.8]);
    near(unit([0, 0, 0]), [0, 0, 0]);
  });
});

describe("angles", () => {
  test("wrap brings an angle within half a turn and leaves its direction", () => {
    for (const angle of [0, 3, -3, 3.2, -3.2, 10, -100, 1e4]) {
      const wrapped = wrap(angle);
      expect(Math.abs(wrapped)).toBeLessThanOrEqual(Math.PI + 1e-9);
      expect(Math.cos(wrapped)).toBeCloseTo(Math.cos(angle), 9);
      expect(Math.sin(wrapped)).toBeCloseTo(Math.sin(angle), 9);
    }
    expect(wrap(350 * DEG - 10 * DEG)).toBeCloseTo(-20 * DEG, 12);
  });

  test("directions: azimuth counter-clockwise from x, zenith from z downwards", () => {
    near(direction(0, 90 * DEG), [1, 0, 0]);
    near(direction(90 * DEG, 90 * DEG), [0, 1, 0]);
    near(direction(33 * DEG, 0), [0, 0, 1]);
    near(direction(180 * DEG, 135 * DEG), [-Math.SQRT1_2, 0, -Math.SQRT1_2]);
  });

  test("the angles of a direction are those that it was made of", () => {
    const draw = random(2);
    for (let n = 0; n < 100; n++) {
      const [azimuth, zenith] = [between(draw, -Math.PI, Math.PI), between(draw, 0.01, Math.PI - 0.01)];
      const found = anglesOf(scale(direction(azimuth, zenith), between(draw, 0.1, 50)));
      expect(found.azimuth).toBeCloseTo(azimuth, 12);
      expect(found.zenith).toBeCloseTo(zenith, 12);
    }
  });
});

describe("a station's frame", () => {
  const turned = (bearing_deg: number, downtilt_deg: number, slant_deg: number): Matrix3 =>
    localToScene({ bearing_deg, downtilt_deg, slant_deg });

  test("bearing, downtilt and slant alone", () => {
    near(multiply(turned(90, 0, 0), [1, 0, 0]), [0, 1, 0]);
    near(multiply(turned(0, 90, 0), [1, 0, 0]), [0, 0, -1]);
    near(multiply(turned(0, 0, 90), [0, 1, 0]), [0, 0, 1]);
    near(multiply(turned(0, 0, 0), [3, 4, 5]), [3, 4, 5]);
  });

  test("a station with a bearing of 45 and a downtilt of 30 deg looks down into that corner", () => {
    near(multiply(turned(45, 30, 0), [1, 0, 0]), direction(45 * DEG, 120 * DEG));
  });

  test("the transposed one turns back", () => {
    const rotation = turned(30, -20, 50);
    near(multiply(transpose(rotation), multiply(rotation, [1, 2, 3])), [1, 2, 3]);
    expect(transpose([[1, 2, 3], [4, 5, 6], [7, 8, 9]])).toEqual([[1, 4, 7], [2, 5, 8], [3, 6, 9]]);
  });

  test("all are rotations", () => {
    const draw = random(3);
    for (let n = 0; n < 50; n++) {
      const [a, b, c] = turned(between(draw, -180, 180), between(draw, -90, 90), between(draw, -180, 180)) as [Vec3, Vec3, Vec3];
      near([dot(a, a), dot(b, b), dot(c, c), dot(a, b), dot(a, c), dot(b, c)], [1, 1, 1, 0, 0, 0]);
      near(cross(a, b), c);
    }
  });
});

describe("eigenvalues", () => {
  const product = (matrix: Matrix3, v: Vec3): Vec3 => multiply(matrix, v);

  test("of a diagonal matrix, largest first", () => {
    const { values, vectors } = eigen([
      [1, 0, 0],
      [0, 9, 0],
      [0, 0, 4],
    ]);
    expect(values).toEqual([9, 4, 1]);
    expect(vectors[0].map(Math.abs)).toEqual([0, 1, 0]);
  });

  test("of covariances: M v = lambda v, orthonormal and right-handed", () => {
    const draw = random(4);
    for (let n = 0; n < 100; n++) {
      const [p, q, r] = [randomVector(draw), randomVector(draw), randomVector(draw, -0.01, 0.01)];
      const matrix = [0, 1, 2].map((i) => [0, 1, 2].map((j) => p[i]! * p[j]! + q[i]! * q[j]! + r[i]! * r[j]!)) as unknown as Matrix3;
      const { values, vectors } = eigen(matrix);
      expect(values[0]).toBeGreaterThanOrEqual(values[1]);
      expect(values[1]).toBeGreaterThanOrEqual(values[2]);
      vectors.forEach((v, k) => near(product(matrix, v), scale(v, values[k]!), 10));
      near([dot(vectors[0], vectors[1]), dot(vectors[0], vectors[0]), dot(vectors[1], vectors[1])], [0, 1, 1], 10);
      near(cross(vectors[0], vectors[1]), vectors[2], 10);
    }
  });

  test("a value that rounding has made negative is zero", () => {
    const { values } = eigen([
      [1, 1, 0],
      [1, 1, 0],
      [0, 0, -1e-18],
    ]);
    near(values, [2, 0, 0]);
    expect(Math.min(...values)).toBeGreaterThanOrEqual(0);
  });
});
