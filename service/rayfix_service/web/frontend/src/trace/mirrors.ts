/**
 * The scene as mirrors: its triangles with the planes they lie on, and rays among them.
 *
 * All positions are in the frame of the mesh, the scene's less `origin`: on map coordinates, which may be millions of
 * metres, an error of a normal's direction would move its plane by metres.
 *
 * Triangles of some materials let rays through as well, which go on straight behind them.
 */

import { add, cross, dot, length, scale, sub, unit } from "../numeric";
import type { Mesh, Vec3 } from "../types";
import { Bvh } from "./bvh";

export interface Plane {
  normal: Vec3;
  /** normal . x of its points. */
  offset: number;
}

const MOST_WALLS = 8;
const MOST_BRANCHES = 60; // of one ray

/** A ray and its reflections. */
export interface Polyline {
  /** Origin, reflection points, end. */
  points: Vec3[];
  /** Plane of each reflection point. */
  planes: number[];
}

/** A path along given planes. */
export interface Way {
  /** Origin, reflection points, end. */
  points: Vec3[];
  /** Where walls are passed, in order. */
  crossings: Vec3[];
}

export class Mirrors {
  readonly bvh: Bvh;
  /** Of the mesh's frame in the scene frame, m. */
  readonly origin: Vec3;
  readonly planes: Plane[] = [];
  /** Plane of each triangle. */
  private readonly planeOf: Int32Array;
  /** Whether each triangle lets rays through. */
  private readonly open: Uint8Array;
  /** Rays start this far from the surface that they leave, m. */
  readonly step: number;

  constructor(mesh: Mesh, openMaterials: readonly string[] = []) {
    this.origin = mesh.origin;
    const total = mesh.groups.reduce((sum, group) => sum + group.indices.length / 3, 0);
    const corners = new Float64Array(9 * total);
    this.open = new Uint8Array(total);
    let place = 0;
    let largest = 1;
    for (const group of mesh.groups) {
      if (openMaterials.includes(group.material)) this.open.fill(1, place / 9, place / 9 + group.indices.length / 3);
      for (const index of group.indices) {
        for (let k = 0; k < 3; k++) {
          const value = mesh.positions[3 * index + k]!;
          corners[place++] = value;
          largest = Math.max(largest, Math.abs(value));
        }
      }
    }
    this.step = 2e-6 * largest;
    this.bvh = new Bvh(corners);
    this.planeOf = new Int32Array(total);
    const known = new Map<string, number>();
    for (let n = 0; n < total; n++) this.planeOf[n] = this.findPlane(n, known);
  }

  private corner(triangle: number, k: number): Vec3 {
    const c = this.bvh.corners;
    const at = 9 * triangle + 3 * k;
    return [c[at]!, c[at + 1]!, c[at + 2]!];
  }

  private findPlane(triangle: number, known: Map<string, number>): number {
    const a = this.corner(triangle, 0);
    const spin = cross(sub(this.corner(triangle, 1), a), sub(this.corner(triangle, 2), a));
    if (length(spin) < 1e-12) return -1;
    let normal = unit(spin);
    // Either side is the same mirror.
    const lead = normal.find((v) => Math.abs(v) > 1e-6) ?? 1;
    if (lead < 0) normal = scale(normal, -1);
    const offset = dot(normal, a);
    const key = [...normal.map((v) => Math.round(v * 1e4)), Math.round(offset * 1e3)].join();
    let plane = known.get(key);
    if (plane === undefined) {
      plane = this.planes.length;
      this.planes.push({ normal, offset });
      known.set(key, plane);
    }
    return plane;
  }

  /** Walls that a straight line passes, in order; null if something opaque is between. */
  between(from: Vec3, to: Vec3): Vec3[] | null {
    const found: Vec3[] = [];
    const apart = sub(to, from);
    const distance = length(apart);
    const heading = unit(apart);
    let done = this.step;
    let last = -1;
    while (done < distance - this.step) {
      const hit = this.bvh.cast(from, heading, done, distance - this.step);
      if (hit === null) break;
      if (!this.open[hit.triangle]) return null;
      const plane = this.planeOf[hit.triangle]!;
      // Triangles of one plane that meet at the crossing are one wall.
      if (plane < 0 || plane !== last) found.push(add(from, heading, hit.distance));
      last = plane;
      done = hit.distance + this.step;
    }
    return found;
  }

  /** The way from a point along its mirrored rays to the end of an unfolded length; null if it is not there. */
  along(origin: Vec3, start: Vec3, sequence: readonly number[], total: number): Way | null {
    const points: Vec3[] = [origin];
    const crossings: Vec3[] = [];
    let at = origin;
    let heading = start;
    let left = total;
    for (const plane of [...sequence, null]) {
      let travel = left;
      if (plane !== null) {
        const { normal, offset } = this.planes[plane]!;
        travel = (offset - dot(normal, at)) / dot(normal, heading);
        if (!(travel > this.step && travel < left)) return null;
        // Something of the plane must be there.
        const mirror = this.bvh.cast(at, heading, travel - this.step, Math.min(left, travel + this.step));
        if (mirror === null || this.planeOf[mirror.triangle] !== plane) return null;
      }
      const next = add(at, heading, travel);
      const walls = this.between(at, next);
      if (walls === null) return null;
      crossings.push(...walls);
      points.push(next);
      at = next;
      left -= travel;
      if (plane !== null) {
        const { normal } = this.planes[plane]!;
        heading = add(heading, normal, -2 * dot(heading, normal));
      }
    }
    return { points, crossings };
  }

  /** Sequences of planes that a ray can be reflected at, each with those before it; it passes what lets it through. */
  *sequences(origin: Vec3, start: Vec3, maxReflections: number, most: number): Generator<number[]> {
    const branches = [{ at: origin, heading: start, left: most, sequence: [] as number[], walls: 0 }];
    for (let n = 0; n < MOST_BRANCHES && branches.length > 0; n++) {
      const { at, heading, left, sequence, walls } = branches.shift()!;
      const hit = this.bvh.cast(at, heading, this.step, left);
      if (hit === null) continue;
      const place = add(at, heading, hit.distance);
      const rest = left - hit.distance;
      const plane = this.planeOf[hit.triangle]!;
      if (plane >= 0 && sequence.length < maxReflections) {
        const { normal } = this.planes[plane]!;
        const mirrored = [...sequence, plane];
        yield mirrored;
        const turned = add(heading, normal, -2 * dot(heading, normal));
        branches.push({ at: place, heading: turned, left: rest, sequence: mirrored, walls });
      }
      if (this.open[hit.triangle] && walls < MOST_WALLS && sequence.length < maxReflections) {
        branches.push({ at: place, heading, left: rest, sequence, walls: walls + 1 });
      }
    }
  }

  /** Mirror a point at a plane. */
  mirror(point: Vec3, plane: number): Vec3 {
    const { normal, offset } = this.planes[plane]!;
    return add(point, normal, 2 * (offset - dot(normal, point)));
  }

  /** Follow a ray through its reflections, for `most` metres. */
  follow(origin: Vec3, start: Vec3, maxReflections: number, most: number): Polyline {
    const points: Vec3[] = [origin];
    const planes: number[] = [];
    let at = origin;
    let heading = start;
    let left = most;
    for (let n = 0; n <= maxReflections; n++) {
      const hit = this.bvh.cast(at, heading, this.step, left);
      if (hit === null) {
        points.push(add(at, heading, left));
        return { points, planes };
      }
      at = add(at, heading, hit.distance);
      left -= hit.distance;
      points.push(at);
      const plane = this.planeOf[hit.triangle]!;
      if (n === maxReflections || plane < 0) return { points, planes };
      const { normal } = this.planes[plane]!;
      planes.push(plane);
      heading = add(heading, normal, -2 * dot(heading, normal));
    }
    return { points, planes };
  }
}
