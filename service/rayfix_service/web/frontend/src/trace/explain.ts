/**
 * Which path explains what a station measured of a position.
 *
 * Rays around the measured direction tell which reflection sequences can be; for each of them the path to the position
 * is exact by mirroring the position (image method). Of those that nothing blocks, the one that fits the measured
 * angles and length best is the explanation.
 */

import { DEG, anglesOf, direction, length, sub, unit, wrap } from "../numeric";
import type { Vec3 } from "../types";
import type { Mirrors } from "./mirrors";

/** What one station measured, in the scene frame; radians and metres. */
export interface Heard {
  azimuth: number | null;
  azimuthStdev: number;
  zenith: number | null;
  zenithStdev: number;
  length: number | null;
  lengthStdev: number;
}

export interface Explanation {
  /** Station, reflection points, position. */
  points: Vec3[];
  length: number;
  azimuth: number;
  zenith: number;
  numReflections: number;
  /** Squared misfit in standard deviations. */
  misfit: number;
}

const RAYS = { disc: 160, azimuths: 11, zeniths: 90, sphere: 4000 };
const REACH = 3; // standard deviations
const WORST = 60; // squared misfit of what still explains anything
const SHORTER = 1e-6; // of misfit for each metre: of paths that fit alike the shorter one, which is the stronger, is told
const GOLDEN = Math.PI * (3 - Math.sqrt(5));

/** Find the path; all positions are in the frame of the mirrors. */
export function explain(
  mirrors: Mirrors,
  station: Vec3,
  position: Vec3,
  heard: Heard,
  maxReflections: number,
  maxLength: number,
): Explanation | null {
  let best = consider(mirrors, station, position, heard, []);
  const seen = new Set<string>([""]);
  for (const ray of raysOf(heard)) {
    const { planes } = mirrors.follow(station, ray, maxReflections, maxLength);
    for (let n = 1; n <= planes.length; n++) {
      const sequence = planes.slice(0, n);
      const key = sequence.join();
      if (seen.has(key)) continue;
      seen.add(key);
      const found = consider(mirrors, station, position, heard, sequence);
      if (found !== null && (best === null || found.misfit < best.misfit)) best = found;
    }
  }
  return best;
}

/** The path of a reflection sequence to the position, if there is one that fits at all. */
function consider(
  mirrors: Mirrors,
  station: Vec3,
  position: Vec3,
  heard: Heard,
  sequence: number[],
): Explanation | null {
  let image = position;
  for (let n = sequence.length - 1; n >= 0; n--) image = mirrors.mirror(image, sequence[n]!);
  const straight = sub(image, station);
  const total = length(straight);
  const { azimuth, zenith } = anglesOf(straight);
  const misfit = misfitOf(heard, azimuth, zenith, total);
  if (!(misfit < WORST)) return null;
  if (sequence.length === 0) {
    if (!mirrors.free(station, position)) return null;
    return { points: [station, position], length: total, azimuth, zenith, numReflections: 0, misfit };
  }
  const traced = mirrors.follow(station, unit(straight), sequence.length, total);
  const same = sequence.every((plane, n) => traced.planes[n] === plane);
  const end = traced.points[traced.points.length - 1]!;
  if (!same || length(sub(end, position)) > 1e-3 * (1 + total)) return null;
  return { points: traced.points, length: total, azimuth, zenith, numReflections: sequence.length, misfit };
}

function misfitOf(heard: Heard, azimuth: number, zenith: number, total: number): number {
  let sum = SHORTER * total;
  if (heard.azimuth !== null) sum += (wrap(azimuth - heard.azimuth) / heard.azimuthStdev) ** 2;
  if (heard.zenith !== null) sum += ((zenith - heard.zenith) / heard.zenithStdev) ** 2;
  if (heard.length !== null) sum += ((total - heard.length) / heard.lengthStdev) ** 2;
  return sum;
}

/** Directions among which the path's may be. */
function* raysOf(heard: Heard): Generator<Vec3> {
  const { azimuth, zenith } = heard;
  if (azimuth !== null && zenith !== null) {
    for (let n = 0; n < RAYS.disc; n++) {
      const radius = REACH * Math.sqrt(n / RAYS.disc);
      yield direction(
        azimuth + radius * Math.cos(n * GOLDEN) * heard.azimuthStdev,
        zenith + radius * Math.sin(n * GOLDEN) * heard.zenithStdev,
      );
    }
  } else if (azimuth !== null) {
    for (let i = 0; i < RAYS.azimuths; i++) {
      const turned = azimuth + REACH * heard.azimuthStdev * ((2 * i) / (RAYS.azimuths - 1) - 1);
      for (let j = 0; j < RAYS.zeniths; j++) yield direction(turned, ((j + 0.5) / RAYS.zeniths) * 180 * DEG);
    }
  } else {
    for (let n = 0; n < RAYS.sphere; n++) {
      yield direction(n * GOLDEN, Math.acos(1 - (2 * (n + 0.5)) / RAYS.sphere));
    }
  }
}
