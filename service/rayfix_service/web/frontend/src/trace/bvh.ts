/** A tree of boxes over triangles, for rays. */

import type { Vec3 } from "../types";

const LEAF = 4;

export interface Hit {
  distance: number;
  triangle: number;
}

export class Bvh {
  /** Corners of each triangle, nine numbers, in the frame of the rays. */
  readonly corners: Float64Array;
  readonly count: number;
  private readonly order: Uint32Array;
  private readonly boxes: Float64Array;
  /** For inner nodes: the right child, the left one follows its parent; for leaves: first triangle. */
  private readonly link: Uint32Array;
  /** Number of triangles of a leaf, 0 for inner nodes. */
  private readonly size: Uint32Array;
  private used = 0;
  private readonly stack = new Uint32Array(128);

  constructor(corners: Float64Array) {
    this.corners = corners;
    this.count = corners.length / 9;
    this.order = Uint32Array.from({ length: this.count }, (_, n) => n);
    const nodes = Math.max(1, 2 * this.count);
    this.boxes = new Float64Array(6 * nodes);
    this.link = new Uint32Array(nodes);
    this.size = new Uint32Array(nodes);
    const centres = new Float64Array(3 * this.count);
    for (let n = 0; n < this.count; n++) {
      for (let k = 0; k < 3; k++) {
        centres[3 * n + k] = (corners[9 * n + k]! + corners[9 * n + 3 + k]! + corners[9 * n + 6 + k]!) / 3;
      }
    }
    if (this.count > 0) this.split(0, this.count, centres);
  }

  /** Build the node of order[begin..end) and return its number. */
  private split(begin: number, end: number, centres: Float64Array): number {
    const node = this.used++;
    const box = this.boxes.subarray(6 * node, 6 * node + 6).fill(Infinity, 0, 3).fill(-Infinity, 3, 6);
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let i = begin; i < end; i++) {
      const triangle = this.order[i]!;
      for (let k = 0; k < 9; k++) {
        const value = this.corners[9 * triangle + k]!;
        if (value < box[k % 3]!) box[k % 3] = value;
        if (value > box[3 + (k % 3)]!) box[3 + (k % 3)] = value;
      }
      for (let k = 0; k < 3; k++) {
        const value = centres[3 * triangle + k]!;
        low[k] = Math.min(low[k]!, value);
        high[k] = Math.max(high[k]!, value);
      }
    }
    const extent = [0, 1, 2].map((k) => high[k]! - low[k]!);
    const axis = extent.indexOf(Math.max(...extent));
    if (end - begin <= LEAF || extent[axis]! <= 0) {
      this.link[node] = begin;
      this.size[node] = end - begin;
      return node;
    }
    const part = this.order.subarray(begin, end);
    part.sort((a, b) => centres[3 * a + axis]! - centres[3 * b + axis]!);
    const middle = (begin + end) >> 1;
    this.split(begin, middle, centres);
    this.link[node] = this.split(middle, end, centres);
    return node;
  }

  /** Nearest triangle along a ray, from `least` to `most` metres. */
  cast(origin: Vec3, direction: Vec3, least: number, most: number): Hit | null {
    if (this.count === 0) return null;
    const [ox, oy, oz] = origin;
    const [dx, dy, dz] = direction;
    const [ix, iy, iz] = [1 / dx, 1 / dy, 1 / dz];
    const { boxes, corners, stack } = this;
    let nearest = most;
    let found = -1;
    let top = 0;
    stack[top++] = 0;
    while (top > 0) {
      const node = stack[--top]!;
      const b = 6 * node;
      const x0 = (boxes[b]! - ox) * ix;
      const x1 = (boxes[b + 3]! - ox) * ix;
      const y0 = (boxes[b + 1]! - oy) * iy;
      const y1 = (boxes[b + 4]! - oy) * iy;
      const z0 = (boxes[b + 2]! - oz) * iz;
      const z1 = (boxes[b + 5]! - oz) * iz;
      // A ray within a box's plane gives NaN, which Math.min would spread: comparisons let it pass.
      let enter = x0 < x1 ? x0 : x1;
      let leave = x0 < x1 ? x1 : x0;
      const ey = y0 < y1 ? y0 : y1;
      const ly = y0 < y1 ? y1 : y0;
      const ez = z0 < z1 ? z0 : z1;
      const lz = z0 < z1 ? z1 : z0;
      if (ey > enter) enter = ey;
      if (ez > enter) enter = ez;
      if (ly < leave) leave = ly;
      if (lz < leave) leave = lz;
      if (enter > leave + 1e-9 || enter > nearest || leave < least) continue;
      const size = this.size[node]!;
      if (size === 0) {
        stack[top++] = node + 1;
        stack[top++] = this.link[node]!;
        continue;
      }
      for (let i = this.link[node]!; i < this.link[node]! + size; i++) {
        const triangle = this.order[i]!;
        const c = 9 * triangle;
        // Moeller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
        const [ax, ay, az] = [corners[c]!, corners[c + 1]!, corners[c + 2]!];
        const [ux, uy, uz] = [corners[c + 3]! - ax, corners[c + 4]! - ay, corners[c + 5]! - az];
        const [vx, vy, vz] = [corners[c + 6]! - ax, corners[c + 7]! - ay, corners[c + 8]! - az];
        const px = dy * vz - dz * vy;
        const py = dz * vx - dx * vz;
        const pz = dx * vy - dy * vx;
        const det = ux * px + uy * py + uz * pz;
        if (Math.abs(det) < 1e-14) continue;
        const inverse = 1 / det;
        const [tx, ty, tz] = [ox - ax, oy - ay, oz - az];
        const s = (tx * px + ty * py + tz * pz) * inverse;
        if (s < -1e-9 || s > 1 + 1e-9) continue;
        const qx = ty * uz - tz * uy;
        const qy = tz * ux - tx * uz;
        const qz = tx * uy - ty * ux;
        const t = (dx * qx + dy * qy + dz * qz) * inverse;
        if (t < -1e-9 || s + t > 1 + 1e-9) continue;
        const distance = (vx * qx + vy * qy + vz * qz) * inverse;
        if (distance > least && distance < nearest) {
          nearest = distance;
          found = triangle;
        }
      }
    }
    return found < 0 ? null : { distance: nearest, triangle: found };
  }
}
