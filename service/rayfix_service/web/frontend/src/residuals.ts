/** From a report and its fix: the paths that explain it, and what is left over of each measurement. */

import { DEG, add, anglesOf, direction, localToScene, multiply, sub, transpose, vec, wrap } from "./numeric";
import { signed, withDeviation } from "./rounding";
import { explain, type Explanation, type Heard } from "./trace/explain";
import type { Mirrors } from "./trace/mirrors";
import type { Fix, Measurement, Report, Site, StationInfo, Vec3 } from "./types";

const METRES_PER_NANOSECOND = 0.299792458;

export interface Residual {
  measurement: Measurement;
  outlierProbability: number | null;
  used: boolean;
  reason: string;
  /** What was measured, a line for each number. */
  text: readonly string[];
  /** Measured minus explained, a line for each number, in the measurement's frame; empty where nothing explains it. */
  difference: readonly string[];
  /** The largest of the differences in standard deviations; null where there is none. */
  sigmas: number | null;
}

export interface ExplainedFix {
  paths: Map<string, Explanation>;
  residuals: Residual[];
}

interface LengthForm {
  value: number;
  stdev: number;
}

export function explainFix(mirrors: Mirrors, site: Site, report: Report, fix: Fix, at: Vec3 | null): ExplainedFix {
  const stations = new Map(site.stations.map((s) => [s.id, s]));
  const paths = new Map<string, Explanation>();
  if (at !== null) {
    for (const id of new Set(report.measurements.flatMap((m) => [m.station_id, m.reference_station_id ?? m.station_id]))) {
      const station = stations.get(id);
      if (station === undefined) continue;
      const mine = report.measurements.filter((m, n) => m.station_id === id && isGood(fix, n));
      const heard = heardBy(station, mine, site.table.site.north_deg * DEG);
      const most = site.table.site.max_path_length_m;
      const { origin } = mirrors;
      const [from, to] = [sub(vec(station.position), origin), sub(at, origin)];
      const path = explain(mirrors, from, to, heard, site.settings.max_reflections, most);
      if (path === null) continue;
      const placed = (at: Vec3): Vec3 => add(at, origin);
      paths.set(id, { ...path, points: path.points.map(placed), crossings: path.crossings.map(placed) });
    }
  }
  const offset = clockOffset(report, paths);
  const residuals = report.measurements.map((measurement, n) => {
    const outcome = fix.measurements.find((o) => o.index === n);
    const station = stations.get(measurement.station_id);
    return {
      measurement,
      used: outcome?.used ?? false,
      reason: outcome?.reason ?? "",
      outlierProbability: outcome?.outlier_probability ?? null,
      ...difference(measurement, station, site.table.site.north_deg * DEG, paths, offset),
    };
  });
  return { paths, residuals };
}

function isGood(fix: Fix, index: number): boolean {
  const outcome = fix.measurements.find((o) => o.index === index);
  return outcome !== undefined && outcome.used && (outcome.outlier_probability ?? 0) < 0.5;
}

/** Direction of an angle in the scene frame, rad. */
export function sceneAngles(
  m: Measurement,
  station: StationInfo,
  north: number,
): { azimuth: number; zenith: number | null } {
  const azimuth = (m.azimuth_deg ?? 0) * DEG;
  const zenith = m.zenith_deg == null ? null : m.zenith_deg * DEG;
  if (m.frame === "north") return { azimuth: wrap(azimuth + north), zenith };
  if (m.frame !== "lcs") return { azimuth: wrap(azimuth), zenith };
  if (zenith === null) return { azimuth: wrap(azimuth + station.orientation.bearing_deg * DEG), zenith };
  return anglesOf(multiply(localToScene(station.orientation), direction(azimuth, zenith)));
}

/** Angles in the frame of a measurement, of a direction in the scene frame; rad. */
export function measuredAngles(
  m: Measurement,
  station: StationInfo,
  north: number,
  scene: { azimuth: number; zenith: number },
): { azimuth: number; zenith: number } {
  if (m.frame === "north") return { azimuth: wrap(scene.azimuth - north), zenith: scene.zenith };
  if (m.frame !== "lcs") return scene;
  return anglesOf(multiply(transpose(localToScene(station.orientation)), direction(scene.azimuth, scene.zenith)));
}

function heardBy(station: StationInfo, measurements: Measurement[], north: number): Heard {
  const angle = measurements.find((m) => m.type === "aoa");
  const range = measurements.find((m) => m.type === "pt");
  const towards = angle ? sceneAngles(angle, station, north) : { azimuth: null, zenith: null };
  const measured = range ? lengthOf(range) : null;
  return {
    ...towards,
    azimuthStdev: (angle?.azimuth_stdev_deg ?? 1) * DEG,
    zenithStdev: (angle?.zenith_stdev_deg ?? 1) * DEG,
    length: measured?.value ?? null,
    lengthStdev: measured?.stdev ?? 1,
  };
}

/** Length that a time measurement tells, m; null for what is no length. */
function lengthOf(m: Measurement): LengthForm | null {
  const number = (key: string): number | null => (typeof m[key] === "number" ? m[key] : null);
  const stdev = number("stdev_m") ?? (number("stdev_ns") ?? 0) * METRES_PER_NANOSECOND;
  const metres = number("range_m") ?? number("range_difference_m");
  if (metres !== null) return { value: metres, stdev };
  const delay = number("delay_ns") ?? number("delay_difference_ns");
  if (delay !== null) return { value: delay * METRES_PER_NANOSECOND, stdev };
  const [toa, tod] = [number("toa_ns"), number("tod_ns")];
  if (toa !== null && tod !== null) return { value: (toa - tod) * METRES_PER_NANOSECOND, stdev };
  const [round, reply] = [number("round_trip_ns"), number("reply_ns")];
  if (round !== null && reply !== null) return { value: 0.5 * (round - reply) * METRES_PER_NANOSECOND, stdev: 0.5 * stdev };
  return null;
}

/** The UE's clock as a length: what times of arrival have in common beyond the paths. */
function clockOffset(report: Report, paths: Map<string, Explanation>): number {
  const apart = report.measurements
    .filter((m) => m.type === "toa")
    .flatMap((m) => {
      const path = paths.get(m.station_id);
      const measured = lengthOf(m);
      return path && measured ? [measured.value - path.length] : [];
    })
    .sort((a, b) => a - b);
  return apart.length ? apart[apart.length >> 1]! : 0;
}

function difference(
  m: Measurement,
  station: StationInfo | undefined,
  north: number,
  paths: Map<string, Explanation>,
  offset: number,
): Pick<Residual, "text" | "difference" | "sigmas"> {
  const path = paths.get(m.station_id);
  if (m.type === "aoa") return angleDifference(m, station, north, path);
  const measured = lengthOf(m);
  if (measured === null) return { text: [m.type], difference: [], sigmas: null };
  const { value, stdev } = measured;
  const text = [withDeviation(value, stdev, " m")];
  const reference = m.reference_station_id === undefined ? undefined : paths.get(m.reference_station_id);
  if (!path || (m.type === "tdoa" && !reference)) return { text, difference: [], sigmas: null };
  const expected = m.type === "tdoa" ? path.length - reference!.length : path.length + (m.type === "toa" ? offset : 0);
  const left = value - expected;
  return { text, difference: [signed(left, stdev, " m")], sigmas: Math.abs(left) / stdev };
}

function angleDifference(
  m: Measurement,
  station: StationInfo | undefined,
  north: number,
  path: Explanation | undefined,
): Pick<Residual, "text" | "difference" | "sigmas"> {
  const stdevs = { azimuth: m.azimuth_stdev_deg ?? 1, zenith: m.zenith_stdev_deg ?? 1 };
  const text = [`azimuth ${withDeviation(m.azimuth_deg!, stdevs.azimuth, "°")}`];
  if (m.zenith_deg != null) text.push(`zenith ${withDeviation(m.zenith_deg, stdevs.zenith, "°")}`);
  if (!path || !station) return { text, difference: [], sigmas: null };
  const expected = measuredAngles(m, station, north, path);
  const turn = wrap(m.azimuth_deg! * DEG - expected.azimuth) / DEG;
  const tilt = m.zenith_deg == null ? null : m.zenith_deg - expected.zenith / DEG;
  const difference = [signed(turn, stdevs.azimuth, "°")];
  if (tilt !== null) difference.push(signed(tilt, stdevs.zenith, "°"));
  const sigmas = Math.max(Math.abs(turn) / stdevs.azimuth, Math.abs(tilt ?? 0) / stdevs.zenith);
  return { text, difference, sigmas };
}
