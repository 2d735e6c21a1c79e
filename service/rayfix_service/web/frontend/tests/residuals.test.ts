import { describe, expect, test } from "vitest";

import { calibrated } from "../src/calibrated";
import { DEG, add, wrap } from "../src/numeric";
import { explainFix, measuredAngles, sceneAngles } from "../src/residuals";
import { Mirrors } from "../src/trace/mirrors";
import type { Calibration, Fix, Measurement, Report, Site, StationInfo, Vec3 } from "../src/types";
import { between, boxes, random } from "./rooms";

const STATION: Vec3 = [1, 1.5, 2];
const POSITION: Vec3 = [4, 1.5, 1];

function station(at: Vec3): StationInfo {
  return {
    id: "bs1",
    position: { x: at[0], y: at[1], z: at[2] },
    orientation: { bearing_deg: 40, downtilt_deg: 20, slant_deg: -15 },
    boresight: { azimuth_deg: 40, downtilt_deg: 20 },
    field_of_view_deg: 360,
    levels: [],
  };
}

const CALIBRATION: Calibration = {
  range_m: 0.4,
  azimuth_deg: 2,
  zenith_deg: -1,
  angles: {
    azimuths_deg: [-180, 0, 180],
    zeniths_deg: [60, 120],
    azimuth_deg: [[0, 3, 0], [0, 6, 0]],
    zenith_deg: [[0, 0, 0], [0, 0, 0]],
  },
  azimuth_stdev_deg: 3,
  zenith_stdev_deg: null,
  range_stdev_m: 0.2,
};

describe("a calibrated measurement", () => {
  const stations = new Map([["bs1", { ...station(STATION), calibration: CALIBRATION }]]);

  test("is without the biases, those that depend on the direction among them", () => {
    // At azimuth 60 and zenith 90 deg the grid has 4.5 * (1 - 60 / 180) = 3 deg.
    const m: Measurement = {
      type: "aoa",
      station_id: "bs1",
      azimuth_deg: 60 + 3 + 2,
      azimuth_stdev_deg: 1,
      zenith_deg: 90 - 1,
      zenith_stdev_deg: 1,
    };
    const found = calibrated(m, stations);
    expect(found.azimuth_deg).toBeCloseTo(60, 4);
    expect(found.zenith_deg).toBeCloseTo(90, 9);
    expect([found.azimuth_stdev_deg, found.zenith_stdev_deg]).toEqual([3, 1]);
  });

  test.each([
    [{ type: "pt", range_m: 7, stdev_m: 1 }, { range_m: 6.6, stdev_m: 0.2 }],
    [{ type: "toa", toa_m: 7, stdev_m: 1 }, { toa_m: 6.6, stdev_m: 0.2 }],
    [{ type: "pt", round_trip_ns: 100, reply_ns: 50, stdev_ns: 1 }, { round_trip_ns: 100 - 0.8 / 0.299792458, stdev_ns: 0.4 / 0.299792458 }],
    [{ type: "tdoa", reference_station_id: "bs2", range_difference_m: 1, stdev_m: 1 }, { range_difference_m: 0.6, stdev_m: 1 }],
    [{ type: "path", delay_ns: 10, stdev_ns: 1 }, { delay_ns: 10 }],
    [{ type: "rssi", rssi_dbm: -60 }, { rssi_dbm: -60 }],
  ])("has the length that is true: %j", (m, expected) => {
    const found = calibrated({ ...m, station_id: "bs1" }, stations);
    for (const [key, value] of Object.entries(expected)) expect(found[key]).toBeCloseTo(value, 9);
  });

  test("is as it was where its station is not calibrated", () => {
    const m: Measurement = { type: "pt", station_id: "bs1", range_m: 7, stdev_m: 1 };
    expect(calibrated(m, new Map([["bs1", station(STATION)]]))).toBe(m);
  });
});

describe("angles in the frame of a measurement", () => {
  test("are those that the scene's were made of, in every frame", () => {
    const draw = random(7);
    for (const frame of ["scene", "north", "lcs"] as const) {
      for (let n = 0; n < 30; n++) {
        const m: Measurement = {
          type: "aoa",
          station_id: "bs1",
          frame,
          azimuth_deg: between(draw, -179, 179),
          zenith_deg: between(draw, 5, 175),
        };
        const scene = sceneAngles(m, station(STATION), 0.7);
        const back = measuredAngles(m, station(STATION), 0.7, { azimuth: scene.azimuth, zenith: scene.zenith! });
        expect(wrap(back.azimuth - m.azimuth_deg! * DEG)).toBeCloseTo(0, 9);
        expect(back.zenith).toBeCloseTo(m.zenith_deg! * DEG, 9);
      }
    }
  });

  test("of a tilted station are those of its own frame, also where only the azimuth was measured", () => {
    const whole: Measurement = { type: "aoa", station_id: "bs1", frame: "lcs", azimuth_deg: 60, zenith_deg: 120 };
    const scene = sceneAngles(whole, station(STATION), 0);
    const alone: Measurement = { type: "aoa", station_id: "bs1", frame: "lcs", azimuth_deg: 60 };
    const found = measuredAngles(alone, station(STATION), 0, { azimuth: scene.azimuth, zenith: scene.zenith! });
    expect(found.azimuth).toBeCloseTo(60 * DEG, 9);
  });
});

describe("a fix explained", () => {
  /** A room whose mesh and positions are all moved by `origin`; the report tells of the reflection at the wall y = 4. */
  function explained(origin: Vec3, calibration: Calibration | null = null): ReturnType<typeof explainFix> {
    const mesh = { ...boxes([[0, 0, 0], [5, 4, 3]]), origin };
    const straight = [3, 5, -1] as const;
    const measurements: Measurement[] = [
      {
        type: "aoa",
        station_id: "bs1",
        azimuth_deg: Math.atan2(straight[1], straight[0]) / DEG + 0.5,
        azimuth_stdev_deg: 1.000416579897,
        zenith_deg: Math.acos(-1 / Math.hypot(...straight)) / DEG,
        zenith_stdev_deg: 2,
      },
      { type: "pt", station_id: "bs1", range_m: Math.hypot(...straight) - 0.25, stdev_m: 0.5 },
    ];
    const report: Report = { measurements };
    const fix = { measurements: measurements.map((_, index) => ({ index, used: true, outlier_probability: 0 })) } as unknown as Fix;
    const site: Site = {
      table: { name: "", table_id: "", software_version: "", num_components: 0, site: { name: "", north_deg: 0, max_path_length_m: 30 } },
      stations: [{ ...station(add(STATION, origin)), calibration }],
      settings: { simulation: false, max_reflections: 2, open_materials: [] },
    };
    return explainFix(new Mirrors(mesh), site, report, fix, add(POSITION, origin));
  }

  test.each([[[0, 0, 0]], [[2_600_000, 1_200_000, 400]]] as const)("has its path and differences, with its origin at %j", (origin) => {
    const { paths, residuals } = explained(origin);
    const path = paths.get("bs1")!;
    expect(path.numReflections).toBe(1);
    const middle = path.points[1]!.map((v, k) => v - origin[k]!);
    [2.5, 4, 1.5].forEach((value, k) => expect(middle[k]).toBeCloseTo(value, 5));
    expect(residuals.map((r) => [r.text, r.difference])).toEqual([
      [["azimuth 59.5 ± 1.0°", "zenith 99.7 ± 2.0°"], ["+0.5°", "0.0°"]],
      [["5.67 ± 0.50 m"], ["−0.25 m"]],
    ]);
    expect(residuals[0]!.sigmas).toBeCloseTo(0.5, 2);
  });

  test("is less the station's biases", () => {
    const found = { ...CALIBRATION, azimuth_deg: 0.5, zenith_deg: 0, angles: null };
    expect(explained([0, 0, 0], found).residuals.map((r) => [r.text, r.difference])).toEqual([
      [["azimuth 59.5 ± 3.0°", "zenith 99.7 ± 2.0°"], ["0.0°", "0.0°"]],
      [["5.67 ± 0.20 m"], ["−0.65 m"]],
    ]);
  });

  test.each(["range_m", "toa_m", "delay_ns"])("has a path for each of several that a station measured, by %s", (length) => {
    const offset = length === "range_m" ? 0 : 71.5;
    const ways: Vec3[] = [[3, 0, -1], [3, 5, -1], [3, -3, -1]]; // straight, by the walls y = 4 and y = 0
    const measurements = ways.map((way): Measurement => {
      const total = Math.hypot(...way) + offset;
      const told = length === "delay_ns" ? { delay_ns: total / 0.299792458, stdev_ns: 1 } : { [length]: total, stdev_m: 0.3 };
      return {
        type: "path",
        station_id: "bs1",
        azimuth_deg: Math.atan2(way[1], way[0]) / DEG,
        azimuth_stdev_deg: 1,
        zenith_deg: Math.acos(way[2] / Math.hypot(...way)) / DEG,
        zenith_stdev_deg: 1,
        ...told,
      };
    });
    const fix = { measurements: measurements.map((_, index) => ({ index, used: true, outlier_probability: 0 })) } as unknown as Fix;
    const { paths, residuals } = explainFix(new Mirrors({ ...boxes([[0, 0, 0], [5, 4, 3]]), origin: [0, 0, 0] }), {
      table: { name: "", table_id: "", software_version: "", num_components: 0, site: { name: "", north_deg: 0, max_path_length_m: 30 } },
      stations: [station(STATION)],
      settings: { simulation: false, max_reflections: 2, open_materials: [] },
    }, { measurements }, fix, POSITION);
    expect([...paths.keys()]).toEqual(["bs1 0", "bs1 1", "bs1 2"]);
    expect(residuals.map((r) => r.path!.numReflections)).toEqual([0, 1, 1]);
    for (const { difference, sigmas } of residuals) {
      expect(difference).toHaveLength(3);
      expect(sigmas).toBeLessThan(0.01);
    }
  });
});
