/** From a report and its fix: the paths that explain it, and what is left over of each measurement. */

import { DEG, anglesOf, direction, localToScene, multiply, vec, wrap } from "./numeric";
import { explain, type Explanation, type Heard } from "./trace/explain";
import type { Mirrors } from "./trace/mirrors";
import type { Fix, Measurement, Report, Site, StationInfo, Vec3 } from "./types";

const METRES_PER_NANOSECOND = 0.299792458;

export interface Residual {
  measurement: Measurement;
  outlierProbability: number | null;
  used: boolean;
  reason: string;
  /** What was measured, in words. */
  text: string;
  /** Measured minus explained, in words; empty where nothing explains it. */
  difference: string;
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
      const path = explain(mirrors, vec(station.position), at, heard, site.settings.max_reflections, most);
      if (path !== null) paths.set(id, path);
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
  if (m.type === "aoa") {
    const whole = m.zenith_deg != null;
    const text = whole
      ? `${m.azimuth_deg!.toFixed(1)}°, ${m.zenith_deg!.toFixed(1)}° ± ${m.azimuth_stdev_deg}°`
      : `${m.azimuth_deg!.toFixed(1)}° ± ${m.azimuth_stdev_deg}°`;
    if (!path || !station) return { text, difference: "", sigmas: null };
    const towards = sceneAngles(m, station, north);
    const turn = wrap(towards.azimuth - path.azimuth) / DEG;
    const tilt = towards.zenith === null ? null : (towards.zenith - path.zenith) / DEG;
    const sigmas = Math.max(
      Math.abs(turn) / (m.azimuth_stdev_deg ?? 1),
      tilt === null ? 0 : Math.abs(tilt) / (m.zenith_stdev_deg ?? 1),
    );
    return { text, difference: signed(turn, "°") + (tilt === null ? "" : `, ${signed(tilt, "°")}`), sigmas };
  }
  const measured = lengthOf(m);
  if (measured === null) return { text: m.type, difference: "", sigmas: null };
  const text = `${measured.value.toFixed(2)} ± ${Number(measured.stdev.toPrecision(2))} m`;
  const reference = m.reference_station_id === undefined ? undefined : paths.get(m.reference_station_id);
  if (!path || (m.type === "tdoa" && !reference)) return { text, difference: "", sigmas: null };
  const expected = m.type === "tdoa" ? path.length - reference!.length : path.length + (m.type === "toa" ? offset : 0);
  const left = measured.value - expected;
  return { text, difference: signed(left, " m"), sigmas: Math.abs(left) / measured.stdev };
}

const signed = (value: number, unit: string): string =>
  `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(2)}${unit}`;
