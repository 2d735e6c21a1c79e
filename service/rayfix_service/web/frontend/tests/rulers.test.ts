import { describe, expect, test } from "vitest";

import { decimalsOfStep, northOnScreen, roundDown, roundUp, scaleBar, screenAxis, ticks } from "../src/rulers";

describe("round lengths", () => {
  test.each([
    [0.7, 0.5, 1],
    [1, 1, 1],
    [1.01, 1, 2],
    [4.9, 2, 5],
    [5, 5, 5],
    [99, 50, 100],
    [1000, 1000, 1000],
    [0.03, 0.02, 0.05],
  ])("around %d are %d and %d", (length, down, up) => {
    expect(roundDown(length)).toBeCloseTo(down, 12);
    expect(roundUp(length)).toBeCloseTo(up, 12);
  });

  test("have as many decimals as tell them apart", () => {
    expect([100, 5, 1, 0.5, 0.2, 0.1, 0.05, 0.001].map(decimalsOfStep)).toEqual([0, 0, 0, 1, 1, 1, 2, 3]);
  });
});

describe("ticks", () => {
  test("are at round coordinates between the ends", () => {
    // 0.05 m a pixel from -1: 80 px are 4 m, so that every fifth metre has one.
    expect(ticks({ axis: 0, start: -1, perPixel: 0.05 }, 0, 240, 80)).toEqual([
      { pixel: 20, text: "0" },
      { pixel: 120, text: "5" },
      { pixel: 220, text: "10" },
    ]);
  });

  test("run backwards where the coordinate falls", () => {
    const found = ticks({ axis: 1, start: 2, perPixel: -0.01 }, 0, 250, 90);
    expect(found.map((t) => t.text)).toEqual(["0", "1", "2"]);
    expect(found.map((t) => Math.round(t.pixel) + 0)).toEqual([200, 100, 0]); // + 0: no -0
  });

  test("keep their decimals on map coordinates", () => {
    const found = ticks({ axis: 0, start: 2_600_000.1, perPixel: 0.005 }, 0, 200, 90);
    expect(found.map((t) => t.text)).toEqual(["2600000.5", "2600001.0"]);
    expect(found.map((t) => Math.round(t.pixel))).toEqual([80, 180]);
  });

  test("are none where there is no room", () => {
    expect(ticks({ axis: 0, start: 0, perPixel: 1 }, 10, 10, 50)).toEqual([]);
    expect(ticks({ axis: 0, start: 0, perPixel: 0 }, 0, 10, 50)).toEqual([]);
  });
});

describe("the picture", () => {
  test("has the axis that runs along its edge", () => {
    expect(screenAxis([1, 2, 3], [0, -0.02, 1e-6])).toEqual({ axis: 1, start: 2, perPixel: -0.02 });
  });

  test("has a scale bar of a round length", () => {
    expect(scaleBar(0.03, 100)).toEqual({ pixels: 2 / 0.03, text: "2 m" });
    expect(scaleBar(0.004, 100).text).toBe("0.2 m");
  });

  test.each([
    ["up, where +y is north and up", 90, [1, 0, 0], [0, -1, 0], 0],
    ["to the right, where +x is north", 0, [1, 0, 0], [0, -1, 0], 90],
    ["to the left, where -x is north", 180, [1, 0, 0], [0, -1, 0], -90],
    ["to the right, where +y is north and runs to the right", 90, [0, 1, 0], [1, 0, 0], 90],
    ["obliquely", 45, [1, 0, 0], [0, -1, 0], 45],
  ] as const)("has north %s", (_, northDeg, right, down, turn) => {
    expect(northOnScreen(northDeg, right, down)).toBeCloseTo(turn, 9);
  });
});
