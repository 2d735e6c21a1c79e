import { describe, expect, test } from "vitest";

import { decimalsOf, deviation, fixed, rounded, signed, withDeviation } from "../src/rounding";

describe("numbers as their deviation deserves", () => {
  test.each([
    [1.000416579897, 1],
    [0.5, 2],
    [0.0996, 2], // 0.10
    [0.0994, 3], // 0.099
    [9.96, 0], // 10
    [12, 0],
    [120, -1],
    [1e-9, 6],
  ])("a deviation of %d leaves %i decimals", (stdev, decimals) => {
    expect(decimalsOf(stdev)).toBe(decimals);
  });

  test("an unknown deviation leaves two", () => {
    for (const stdev of [0, NaN, Infinity, -1]) expect(decimalsOf(stdev)).toBe(2);
  });

  test("values and deviations end at the same decimal", () => {
    expect(withDeviation(69.61234, 1.000416579897, "°")).toBe("69.6 ± 1.0°");
    expect(withDeviation(15.2, 0.5, " m")).toBe("15.20 ± 0.50 m");
    expect(withDeviation(2600123.4567, 0.034, " m")).toBe("2600123.457 ± 0.034 m");
    expect(withDeviation(1234.5, 120, " m")).toBe("1230 ± 120 m");
    expect(rounded(-3.14159, 0.2)).toBe("-3.14");
    expect(deviation(0.1749)).toBe("0.17");
  });

  test("zero has no sign", () => {
    expect(fixed(-0.001, 2)).toBe("0.00");
    expect(fixed(-4, -1)).toBe("0");
    expect(signed(-0.001, 0.5, " m")).toBe("0.00 m");
  });

  test("differences have one", () => {
    expect(signed(1.26, 1, "°")).toBe("+1.3°");
    expect(signed(-0.126, 0.5, " m")).toBe("−0.13 m");
  });
});
