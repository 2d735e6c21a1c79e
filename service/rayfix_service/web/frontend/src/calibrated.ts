/** Measurements less what the calibration of their stations has found, as the fusion takes them. */

import { METRES_PER_NANOSECOND } from "./numeric";
import type { Calibration, Measurement, StationInfo } from "./types";

const LENGTHS = ["range_m", "range_difference_m", "toa_m"] as const;
const DELAYS = ["delay_ns", "delay_difference_ns", "round_trip_ns", "toa_ns"] as const;

/** Without biases, with the deviations that were found; the measurement itself where its station is not calibrated. */
export function calibrated(m: Measurement, stations: Map<string, StationInfo>): Measurement {
  const own = stations.get(m.station_id)?.calibration;
  const reference = m.reference_station_id === undefined ? null : stations.get(m.reference_station_id)?.calibration;
  if (!own && !reference) return m;
  const changed: Measurement = { ...m };
  if (own && m.azimuth_deg !== undefined) turnBack(changed, own);
  // On the station's own clock, lengths count from its first path on, which has the same bias.
  const relative = m.type === "path" && typeof m["delay_ns"] === "number";
  if (m.type !== "rssi" && !relative) shorten(changed, (own?.range_m ?? 0) - (reference?.range_m ?? 0));
  if (own?.range_stdev_m != null && m.type !== "tdoa" && m.type !== "rssi" && typeof changed["stdev_m"] === "number") {
    changed["stdev_m"] = own.range_stdev_m;
  } else if (own?.range_stdev_m != null && m.type !== "tdoa" && typeof changed["stdev_ns"] === "number") {
    const twice = typeof m["round_trip_ns"] === "number" ? 2 : 1;
    changed["stdev_ns"] = (twice * own.range_stdev_m) / METRES_PER_NANOSECOND;
  }
  return changed;
}

function turnBack(m: Measurement, found: Calibration): void {
  const azimuth = m.azimuth_deg! - found.azimuth_deg;
  const zenith = m.zenith_deg == null ? null : m.zenith_deg - found.zenith_deg;
  const [more, above] = biasAt(found.angles, azimuth, zenith ?? 90);
  m.azimuth_deg = azimuth - more;
  if (zenith !== null) m.zenith_deg = Math.min(Math.max(zenith - above, 0), 180);
  if (found.azimuth_stdev_deg !== null) {
    m.azimuth_stdev_deg = found.azimuth_stdev_deg;
    if (zenith !== null && found.zenith_stdev_deg !== null) m.zenith_stdev_deg = found.zenith_stdev_deg;
  }
}

function shorten(m: Measurement, by: number): void {
  for (const key of LENGTHS) if (typeof m[key] === "number") m[key] = m[key] - by;
  for (const key of DELAYS) {
    const twice = key === "round_trip_ns" ? 2 : 1;
    if (typeof m[key] === "number") m[key] = m[key] - (twice * by) / METRES_PER_NANOSECOND;
  }
}

/** Bias of azimuth and zenith in a measured direction; it is that of the true one, which a few steps find. */
function biasAt(angles: Calibration["angles"], azimuth: number, zenith: number): [number, number] {
  if (angles === null) return [0, 0];
  let found: [number, number] = [0, 0];
  for (let step = 0; step < 20; step++) {
    const at: [number, number] = [azimuth - found[0], zenith - found[1]];
    const next = [interpolated(angles, angles.azimuth_deg, at), interpolated(angles, angles.zenith_deg, at)];
    // Half steps also end where the bias grows as fast as the angle.
    found = [0.5 * (found[0] + next[0]!), 0.5 * (found[1] + next[1]!)];
  }
  return found;
}

function interpolated(angles: NonNullable<Calibration["angles"]>, rows: number[][], [azimuth, zenith]: [number, number]): number {
  const { azimuths_deg: across, zeniths_deg: down } = angles;
  const middle = 0.5 * (across[0]! + across[across.length - 1]!);
  const turned = azimuth - 360 * Math.round((azimuth - middle) / 360);
  const [i, s] = cell(across, turned);
  const [j, t] = cell(down, zenith);
  const inRow = (row: number[]): number => row[i]! + s * (row[Math.min(i + 1, row.length - 1)]! - row[i]!);
  const low = inRow(rows[j]!);
  return low + t * (inRow(rows[Math.min(j + 1, rows.length - 1)]!) - low);
}

/** Cell of an ascending axis, and where in it; beyond the axis its edge. */
function cell(axis: number[], value: number): [number, number] {
  let i = 0;
  while (i < axis.length - 2 && value >= axis[i + 1]!) i++;
  if (axis.length === 1) return [0, 0];
  return [i, Math.min(Math.max((value - axis[i]!) / (axis[i + 1]! - axis[i]!), 0), 1)];
}
