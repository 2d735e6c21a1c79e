import { describe, expect, test } from "vitest";

import { add, dot, length, sub, unit } from "../src/numeric";
import { Mirrors } from "../src/trace/mirrors";
import type { Vec3 } from "../src/types";
import { boxes, random, randomVector } from "./rooms";

const ROOM = boxes([[0, 0, 0], [5, 4, 3]]);
const FURNISHED = boxes([[0, 0, 0], [5, 4, 3]], [[2, 1, 0], [3, 2, 2]]);

function near(found: readonly number[], expected: readonly number[], digits = 5): void {
  expected.forEach((value, n) => expect(found[n]).toBeCloseTo(value, digits));
}

describe("the scene as mirrors", () => {
  test("triangles of one side are one plane, and so are sides of two objects in one plane", () => {
    expect(new Mirrors(ROOM).planes).toHaveLength(6);
    expect(new Mirrors(FURNISHED).planes).toHaveLength(11); // the cupboard stands on the floor
  });

  test("a point is mirrored at each plane and back", () => {
    const mirrors = new Mirrors(ROOM);
    const draw = random(5);
    mirrors.planes.forEach(({ normal, offset }, plane) => {
      const point = randomVector(draw, 0, 3);
      const image = mirrors.mirror(point, plane);
      near(mirrors.mirror(image, plane), point, 12);
      expect(dot(normal, image) + dot(normal, point)).toBeCloseTo(2 * offset, 12);
      expect(length(sub(image, point))).toBeCloseTo(2 * Math.abs(dot(normal, point) - offset), 12);
    });
  });

  test("a mesh's origin changes nothing: the frame is the mesh's", () => {
    const moved = new Mirrors({ ...ROOM, origin: [2_600_000, 1_200_000, 400] });
    expect(moved.planes).toEqual(new Mirrors(ROOM).planes);
    expect(moved.step).toBe(new Mirrors(ROOM).step);
    expect(moved.origin).toEqual([2_600_000, 1_200_000, 400]);
  });

  test("nothing is between points of an empty room; a cupboard is between those on both sides of it", () => {
    expect(new Mirrors(ROOM).between([1, 1.5, 1], [4, 1.5, 1])).toEqual([]);
    const mirrors = new Mirrors(FURNISHED);
    expect(mirrors.between([1, 1.5, 1], [4, 1.5, 1])).toBeNull();
    expect(mirrors.between([1, 1.5, 2.5], [4, 1.5, 2.5])).toEqual([]);
    expect(mirrors.between([1, 1, 1], [1, 1, 1])).toEqual([]);
  });

  test("a cupboard that lets signals through is passed at two sides, each counted once", () => {
    const mirrors = new Mirrors(FURNISHED, ["material 1"]);
    const found = mirrors.between([1, 1.5, 1], [4, 1.5, 1])!;
    expect(found.map((at) => Math.round(at[0] * 1e5) / 1e5)).toEqual([2, 3]);
    // Through the common edge of a side's two triangles, too.
    expect(mirrors.between([1, 1.5, 1], [4, 1.5, 1])).toHaveLength(2);
    const walls = new Mirrors(FURNISHED, ["material 0"]);
    expect(walls.between([1, 1.5, 1], [4, 1.5, 1])).toBeNull();
  });

  test("a ray of 45 deg in a room: exact points", () => {
    //  y = 4 +-----*-----+     from (0.5, 2) towards (1, 1): at the wall y = 4 in x = 2.5,
    //        |    / \    |     at the wall x = 5 in y = 1.5, and down to the wall y = 0 in x = 3.5
    //        |   /   \   |
    //        | o      \  |
    //  y = 0 +---------*-+
    const { points, planes } = new Mirrors(ROOM).follow([0.5, 2, 1], unit([1, 1, 0]), 2, 100);
    near(points[1]!, [2.5, 4, 1]);
    near(points[2]!, [5, 1.5, 1]);
    near(points[3]!, [3.5, 0, 1]);
    expect(points).toHaveLength(4);
    expect(planes).toHaveLength(2);
  });

  test("a ray ends after its length", () => {
    const { points, planes } = new Mirrors(ROOM).follow([1, 1, 1], [1, 0, 0], 5, 6);
    near(points.at(-1)!, [3, 1, 1]);
    expect(planes).toHaveLength(1);
  });

  test("angles of incidence and reflection agree, and an unfolded path is straight", () => {
    const mirrors = new Mirrors(FURNISHED);
    const draw = random(6);
    for (let n = 0; n < 100; n++) {
      const start = unit(randomVector(draw));
      const { points, planes } = mirrors.follow([1, 3, 1.5], start, 3, 12);
      for (let k = 0; k < planes.length; k++) {
        const { normal } = mirrors.planes[planes[k]!]!;
        const arriving = unit(sub(points[k + 1]!, points[k]!));
        const leaving = unit(sub(points[k + 2]!, points[k + 1]!));
        expect(dot(arriving, normal)).toBeCloseTo(-dot(leaving, normal), 5);
      }
      let end: Vec3 = points.at(-1)!;
      for (let k = planes.length - 1; k >= 0; k--) end = mirrors.mirror(end, planes[k]!);
      const total = points.slice(1).reduce((sum, point, k) => sum + length(sub(point, points[k]!)), 0);
      near(end, add([1, 3, 1.5], start, total), 4);
    }
  });
});
