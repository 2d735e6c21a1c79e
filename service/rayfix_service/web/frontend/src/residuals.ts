/** From a report and its fix: the paths that explain it, and what is left over of each measurement. */

import { calibrated } from "./calibrated";
import { DEG, METRES_PER_NANOSECOND, add, anglesOf, direction, localToScene, multiply, sub, transpose, vec, wrap } from "./numeric";
import { signed, withDeviation } from "./rounding";
import { explain, type Explanation, type Heard } from "./trace/explain";
import type { Mirrors } from "./trace/mirrors";
import type { Fix, Measurement, Report, Site, StationInfo, Vec3 } from "./types";

export interface Residual {
  measurement: Measurement;
  outlierProbability: number | null;
  used: boolean;
  reason: string;
  /** What was measured, a line for each number. */
  text: readonly string[];
  /** Measured minus explained and the station's biases, a line for each number; empty where nothing explains it. */
  difference: readonly string[];
  /** The largest of the differences in standard deviations; null where there is none. */
  sigmas: number | null;
  /** What explains it. */
  path: Explanation | undefined;
}

export interface ExplainedFix {
  /** By station; of several paths of a station, by station and number of the measurement. */
  paths: Map<string, Explanation>;
  residuals: Residual[];
}

type Differences = Pick<Residual, "difference" | "sigmas">;

const UNEXPLAINED: Differences = { difference: [], sigmas: null };

interface LengthForm {
  value: number;
  stdev: number;
}

export function explainFix(mirrors: Mirrors, site: Site, reported: Report, fix: Fix, at: Vec3 | null): ExplainedFix {
  const stations = new Map(site.stations.map((s) => [s.id, s]));
  const report = { ...reported, measurements: reported.measurements.map((m) => calibrated(m, stations)) };
  const north = site.table.site.north_deg * DEG;
  const paths = new Map<string, Explanation>();
  const several = new Map<number, Explanation>();
  const offsets = new Map<string, number>();
  if (at !== null) {
    const { origin } = mirrors;
    const placed = (place: Vec3): Vec3 => add(place, origin);
    const pathOf: Find = (id, heard) => {
      const from = sub(vec(stations.get(id)!.position), origin);
      const most = site.table.site.max_path_length_m;
      const path = explain(mirrors, from, sub(at, origin), heard, site.settings.max_reflections, most);
      return path && { ...path, points: path.points.map(placed), crossings: path.crossings.map(placed) };
    };
    const single = report.measurements.filter((m) => m.type !== "path");
    for (const id of new Set(single.flatMap((m) => [m.station_id, m.reference_station_id ?? m.station_id]))) {
      const station = stations.get(id);
      if (station === undefined) continue;
      const mine = report.measurements.filter((m, n) => m.type !== "path" && m.station_id === id && isGood(fix, n));
      const path = pathOf(id, heardBy(station, mine, north));
      if (path !== null) paths.set(id, path);
    }
    explainSeveral(report, fix, stations, north, pathOf, several, offsets);
    for (const [n, path] of several) {
      if (isGood(fix, n)) paths.set(`${report.measurements[n]!.station_id} ${n}`, path);
    }
  }
  const offset = clockOffset(report, paths);
  const residuals = reported.measurements.map((measurement, n) => {
    const corrected = report.measurements[n]!;
    const outcome = fix.measurements.find((o) => o.index === n);
    const station = stations.get(measurement.station_id);
    return {
      measurement,
      used: outcome?.used ?? false,
      reason: outcome?.reason ?? "",
      outlierProbability: outcome?.outlier_probability ?? null,
      text: textOf(measurement, corrected),
      ...(measurement.type === "path"
        ? pathDifference(corrected, station, north, several.get(n), offsets.get(clockOf(measurement) ?? "") ?? 0)
        : difference(corrected, station, north, paths, offset)),
      path: several.get(n) ?? paths.get(measurement.station_id),
    };
  });
  return { paths, residuals };
}

type Find = (station: string, heard: Heard) => Explanation | null;

/** Whose clock the length of a measured path counts on, where its offset is unknown. */
function clockOf(m: Measurement): string | null {
  if (typeof m["toa_m"] === "number") return "";
  return typeof m["delay_ns"] === "number" ? `of ${m.station_id}` : null;
}

/**
 * Explain each of several paths of a station: by its direction and a length on a known clock first; the offsets of
 * other clocks are the middle of what is left over then, and their lengths count in a second round.
 */
function explainSeveral(
  report: Report,
  fix: Fix,
  stations: Map<string, StationInfo>,
  north: number,
  pathOf: Find,
  several: Map<number, Explanation>,
  offsets: Map<string, number>,
): void {
  const measured = [...report.measurements.entries()].filter(([, m]) => m.type === "path" && stations.has(m.station_id));
  const left = new Map<string, number[]>();
  for (const [n, m] of measured) {
    const path = pathOf(m.station_id, heardOfPath(m, stations.get(m.station_id)!, north, 0));
    if (path === null) continue;
    several.set(n, path);
    const clock = clockOf(m);
    if (clock !== null && m.azimuth_deg !== undefined && isGood(fix, n)) {
      left.set(clock, [...(left.get(clock) ?? []), lengthOf(m)!.value - path.length]);
    }
  }
  for (const [clock, apart] of left) offsets.set(clock, apart.sort((a, b) => a - b)[apart.length >> 1]!);
  for (const [n, m] of measured) {
    const offset = offsets.get(clockOf(m) ?? "known");
    if (offset === undefined) continue;
    const path = pathOf(m.station_id, heardOfPath(m, stations.get(m.station_id)!, north, offset));
    if (path !== null) several.set(n, path);
  }
}

/** One measured path; its length counts where the clock's offset is known or not 0. */
function heardOfPath(m: Measurement, station: StationInfo, north: number, offset: number): Heard {
  const towards = m.azimuth_deg === undefined ? { azimuth: null, zenith: null } : sceneAngles(m, station, north);
  const measured = clockOf(m) === null || offset !== 0 ? lengthOf(m) : null;
  return {
    ...towards,
    azimuthStdev: (m.azimuth_stdev_deg ?? 1) * DEG,
    zenithStdev: (m.zenith_stdev_deg ?? 1) * DEG,
    length: measured === null ? null : measured.value - offset,
    lengthStdev: measured?.stdev ?? 1,
  };
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
  const metres = number("range_m") ?? number("range_difference_m") ?? number("toa_m");
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

/** What was measured, with the deviation that counts. */
function textOf(m: Measurement, corrected: Measurement): string[] {
  const text = [];
  if (m.azimuth_deg !== undefined) text.push(`azimuth ${withDeviation(m.azimuth_deg, corrected.azimuth_stdev_deg ?? 1, "°")}`);
  if (m.zenith_deg != null) text.push(`zenith ${withDeviation(m.zenith_deg, corrected.zenith_stdev_deg ?? 1, "°")}`);
  const measured = lengthOf(m);
  if (measured !== null) text.push(withDeviation(measured.value, lengthOf(corrected)!.stdev, " m"));
  return text.length ? text : [m.type];
}

function difference(
  m: Measurement,
  station: StationInfo | undefined,
  north: number,
  paths: Map<string, Explanation>,
  offset: number,
): Differences {
  const path = paths.get(m.station_id);
  if (m.type === "aoa") return angleDifference(m, station, north, path);
  const measured = lengthOf(m);
  const reference = m.reference_station_id === undefined ? undefined : paths.get(m.reference_station_id);
  if (measured === null || !path || (m.type === "tdoa" && !reference)) return UNEXPLAINED;
  const { value, stdev } = measured;
  const expected = m.type === "tdoa" ? path.length - reference!.length : path.length + (m.type === "toa" ? offset : 0);
  const left = value - expected;
  return { difference: [signed(left, stdev, " m")], sigmas: Math.abs(left) / stdev };
}

function pathDifference(
  m: Measurement,
  station: StationInfo | undefined,
  north: number,
  path: Explanation | undefined,
  offset: number,
): Differences {
  const angle = m.azimuth_deg === undefined ? UNEXPLAINED : angleDifference(m, station, north, path);
  const measured = lengthOf(m);
  const difference = [...angle.difference];
  const sigmas = angle.sigmas === null ? [] : [angle.sigmas];
  if (measured !== null && path) {
    const left = measured.value - offset - path.length;
    difference.push(signed(left, measured.stdev, " m"));
    sigmas.push(Math.abs(left) / measured.stdev);
  }
  return { difference, sigmas: sigmas.length ? Math.max(...sigmas) : null };
}

function angleDifference(
  m: Measurement,
  station: StationInfo | undefined,
  north: number,
  path: Explanation | undefined,
): Differences {
  if (!path || !station) return UNEXPLAINED;
  const stdevs = { azimuth: m.azimuth_stdev_deg ?? 1, zenith: m.zenith_stdev_deg ?? 1 };
  const expected = measuredAngles(m, station, north, path);
  const turn = wrap(m.azimuth_deg! * DEG - expected.azimuth) / DEG;
  const tilt = m.zenith_deg == null ? null : m.zenith_deg - expected.zenith / DEG;
  const difference = [signed(turn, stdevs.azimuth, "°")];
  if (tilt !== null) difference.push(signed(tilt, stdevs.zenith, "°"));
  const sigmas = Math.max(Math.abs(turn) / stdevs.azimuth, Math.abs(tilt ?? 0) / stdevs.zenith);
  return { difference, sigmas };
}
