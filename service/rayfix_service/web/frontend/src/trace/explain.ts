/**
 * Which path explains what a station measured of a position.
 *
 * Rays around the measured direction tell which reflection sequences can be; for each of them the path to the position
 * is exact by mirroring the position (image method). It goes straight through walls that let signals through; what these
 * add to its length is left out. Of the paths that nothing opaque blocks, the one that fits the measured angles and
 * length best is the explanation.
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
  /** Where it passes walls, in order from the station. */
  crossings: Vec3[];
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
    for (const sequence of mirrors.sequences(station, ray, maxReflections, maxLength)) {
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
  const way = mirrors.along(station, unit(straight), sequence, total);
  if (way === null || length(sub(way.points.at(-1)!, position)) > 1e-3 * (1 + total)) return null;
  const points = [...way.points.slice(0, -1), position];
  return { points, crossings: way.crossings, length: total, azimuth, zenith, numReflections: sequence.length, misfit };
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
