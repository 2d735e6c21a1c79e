/** Vectors, angles and symmetric matrices. Angles are in radians, lengths in metres, the frame is the scene's. */

import type { Matrix3, Point, StationInfo, Vec3 } from "./types";

export const DEG = Math.PI / 180;
export const METRES_PER_NANOSECOND = 0.299792458;

export const vec = (p: Point): Vec3 => [p.x, p.y, p.z];
export const add = (a: Vec3, b: Vec3, s = 1): Vec3 => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const sub = (a: Vec3, b: Vec3): Vec3 => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a: Vec3, s: number): Vec3 => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a: Vec3, b: Vec3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a: Vec3, b: Vec3): Vec3 => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const length = (a: Vec3): number => Math.hypot(a[0], a[1], a[2]);
export const unit = (a: Vec3): Vec3 => scale(a, 1 / (length(a) || 1));

/** Wrap an angle into [-pi, pi]; azimuths are never subtracted bare. */
export function wrap(angle: number): number {
  return angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
}

export function direction(azimuth: number, zenith: number): Vec3 {
  const ring = Math.sin(zenith);
  return [ring * Math.cos(azimuth), ring * Math.sin(azimuth), Math.cos(zenith)];
}

export function anglesOf(v: Vec3): { azimuth: number; zenith: number } {
  return { azimuth: Math.atan2(v[1], v[0]), zenith: Math.atan2(Math.hypot(v[0], v[1]), v[2]) };
}

export const multiply = (m: Matrix3, v: Vec3): Vec3 => [dot(m[0]!, v), dot(m[1]!, v), dot(m[2]!, v)];

export const transpose = (m: Matrix3): Matrix3 => [0, 1, 2].map((j) => m.map((row) => row[j as 0 | 1 | 2])) as unknown as Matrix3;

/** Rotation from a station's local frame to the scene's: Rz(bearing) Ry(downtilt) Rx(slant), TR 38.901 (7.1-2). */
export function localToScene(orientation: StationInfo["orientation"]): Matrix3 {
  const [ca, cb, cc] = [orientation.bearing_deg, orientation.downtilt_deg, orientation.slant_deg].map((a) =>
    Math.cos(a * DEG),
  ) as [number, number, number];
  const [sa, sb, sc] = [orientation.bearing_deg, orientation.downtilt_deg, orientation.slant_deg].map((a) =>
    Math.sin(a * DEG),
  ) as [number, number, number];
  return [
    [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
    [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
    [-sb, cb * sc, cb * cc],
  ];
}

export interface Eigen {
  /** Largest first. */
  values: Vec3;
  /** Unit vectors in the order of the values; right-handed. */
  vectors: readonly [Vec3, Vec3, Vec3];
}

/** Eigenvalues and vectors of a symmetric matrix, by Jacobi rotations. */
export function eigen(matrix: Matrix3): Eigen {
  const a = matrix.map((row) => [...row]);
  const v = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ];
  for (let sweep = 0; sweep < 24; sweep++) {
    const off = Math.abs(a[0]![1]!) + Math.abs(a[0]![2]!) + Math.abs(a[1]![2]!);
    const size = Math.abs(a[0]![0]!) + Math.abs(a[1]![1]!) + Math.abs(a[2]![2]!);
    if (off <= 1e-14 * size) break;
    for (const [p, q] of [
      [0, 1],
      [0, 2],
      [1, 2],
    ] as const) {
      if (a[p]![q] === 0) continue;
      const theta = (a[q]![q]! - a[p]![p]!) / (2 * a[p]![q]!);
      const t = Math.sign(theta || 1) / (Math.abs(theta) + Math.hypot(theta, 1));
      const c = 1 / Math.hypot(t, 1);
      const s = t * c;
      for (let k = 0; k < 3; k++) {
        const [kp, kq] = [a[k]![p]!, a[k]![q]!];
        a[k]![p] = c * kp - s * kq;
        a[k]![q] = s * kp + c * kq;
      }
      for (let k = 0; k < 3; k++) {
        const [pk, qk] = [a[p]![k]!, a[q]![k]!];
        a[p]![k] = c * pk - s * qk;
        a[q]![k] = s * pk + c * qk;
        const [vp, vq] = [v[k]![p]!, v[k]![q]!];
        v[k]![p] = c * vp - s * vq;
        v[k]![q] = s * vp + c * vq;
      }
    }
  }
  const order = [0, 1, 2].sort((i, j) => a[j]![j]! - a[i]![i]!);
  const column = (k: number): Vec3 => [v[0]![k]!, v[1]![k]!, v[2]![k]!];
  const first = column(order[0]!);
  const second = column(order[1]!);
  return {
    values: order.map((k) => Math.max(a[k]![k]!, 0)) as unknown as Vec3,
    vectors: [first, second, cross(first, second)],
  };
}
