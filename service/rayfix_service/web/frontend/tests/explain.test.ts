import { describe, expect, test } from "vitest";

import { DEG, anglesOf, length, sub } from "../src/numeric";
import { type Heard, explain } from "../src/trace/explain";
import { Mirrors } from "../src/trace/mirrors";
import type { Vec3 } from "../src/types";
import { boxes } from "./rooms";

const ROOM = new Mirrors(boxes([[0, 0, 0], [5, 4, 3]]));
/** A cupboard, as high as the room, is between the station and the position. */
const BLOCKED = new Mirrors(boxes([[0, 0, 0], [5, 4, 3]], [[2, 1, 0], [3, 2, 3]]));
const STATION: Vec3 = [1, 1.5, 2];
const POSITION: Vec3 = [4, 1.5, 1];
/** The position behind the wall y = 4. */
const IMAGE: Vec3 = [4, 6.5, 1];

const DEVIATIONS = { azimuthStdev: 1 * DEG, zenithStdev: 1 * DEG, lengthStdev: 0.5 };

/** What the station measures of a path that leaves it towards a point, without noise. */
function heard(towards: Vec3, known: Partial<Heard> = {}): Heard {
  const straight = sub(towards, STATION);
  return { ...anglesOf(straight), length: length(straight), ...DEVIATIONS, ...known };
}

describe("the path that explains a measurement", () => {
  test("is the direct one where that was measured", () => {
    const found = explain(ROOM, STATION, POSITION, heard(POSITION), 2, 30)!;
    expect(found.points).toEqual([STATION, POSITION]);
    expect(found.numReflections).toBe(0);
    expect(found.misfit).toBeLessThan(1e-4);
  });

  test.each([
    ["an empty room", ROOM],
    ["a room with a cupboard in the way", BLOCKED],
  ])("is the reflection at the wall in %s", (_, room) => {
    const found = explain(room, STATION, POSITION, heard(IMAGE), 2, 30)!;
    expect(found.numReflections).toBe(1);
    expect(found.length).toBeCloseTo(length(sub(IMAGE, STATION)), 6);
    expect(found.points).toHaveLength(3);
    // Both are 2.5 m from the wall: the reflection is in the middle.
    [2.5, 4, 1.5].forEach((value, k) => expect(found.points[1]![k]).toBeCloseTo(value, 5));
    POSITION.forEach((value, k) => expect(found.points[2]![k]).toBeCloseTo(value, 4));
  });

  test("is found from the azimuth alone and from the length alone", () => {
    const azimuth = explain(BLOCKED, STATION, POSITION, heard(IMAGE, { zenith: null, length: null }), 1, 30)!;
    expect(azimuth.numReflections).toBe(1);
    expect(azimuth.points[1]![1]).toBeCloseTo(4, 5);
    const range = explain(BLOCKED, STATION, POSITION, heard(IMAGE, { azimuth: null, zenith: null, lengthStdev: 0.1 }), 1, 30)!;
    expect(range.length).toBeCloseTo(length(sub(IMAGE, STATION)), 6);
  });

  test("is none where a wall is between, or no path leaves in that direction", () => {
    expect(explain(BLOCKED, STATION, POSITION, heard(POSITION), 0, 30)).toBeNull();
    expect(explain(ROOM, STATION, POSITION, heard(IMAGE), 0, 30)).toBeNull();
    expect(explain(ROOM, STATION, POSITION, heard([1, -9, 2]), 1, 30)).toBeNull();
  });

  test("goes through a cupboard that lets signals through, straight and reflected behind it", () => {
    const open = new Mirrors(boxes([[0, 0, 0], [5, 4, 3]], [[2, 1, 0], [3, 2, 3]]), ["material 1"]);
    const straight = explain(open, STATION, POSITION, heard(POSITION), 2, 30)!;
    expect(straight.numReflections).toBe(0);
    expect(straight.points).toEqual([STATION, POSITION]);
    expect(straight.crossings.map((at) => Math.round(at[0] * 1e4) / 1e4)).toEqual([2, 3]);
    // The wall x = 5 mirrors the position to (6, 1.5, 1); the way there passes the cupboard.
    const behind = explain(open, STATION, POSITION, heard([6, 1.5, 1]), 1, 30)!;
    expect(behind.numReflections).toBe(1);
    expect(behind.points[1]![0]).toBeCloseTo(5, 5);
    expect(behind.crossings).toHaveLength(2);
    expect(explain(BLOCKED, STATION, POSITION, heard([6, 1.5, 1]), 1, 30)).toBeNull();
  });

  test("fits an azimuth on the other side of the cut at 180 deg", () => {
    const station: Vec3 = [4, 1.5, 2];
    const straight = sub([1, 1.5, 1], station); // azimuth 180 deg
    const measured = { ...DEVIATIONS, azimuth: -179.9 * DEG, zenith: anglesOf(straight).zenith, length: null };
    const found = explain(ROOM, station, [1, 1.5, 1], measured, 0, 30)!;
    expect(found.misfit).toBeCloseTo(0.01, 4);
  });
});
