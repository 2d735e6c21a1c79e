/**
 * The scene as mirrors: its triangles with the planes they lie on, and rays among them.
 *
 * All positions are in the frame of the mesh, the scene's less `origin`: on map coordinates, which may be millions of
 * metres, an error of a normal's direction would move its plane by metres.
 */

import { add, cross, dot, length, scale, sub, unit } from "../numeric";
import type { Mesh, Vec3 } from "../types";
import { Bvh } from "./bvh";

export interface Plane {
  normal: Vec3;
  /** normal . x of its points. */
  offset: number;
}

/** A ray and its reflections. */
export interface Polyline {
  /** Origin, reflection points, end. */
  points: Vec3[];
  /** Plane of each reflection point. */
  planes: number[];
}

export class Mirrors {
  readonly bvh: Bvh;
  /** Of the mesh's frame in the scene frame, m. */
  readonly origin: Vec3;
  readonly planes: Plane[] = [];
  /** Plane of each triangle. */
  private readonly planeOf: Int32Array;
  /** Rays start this far from the surface that they leave, m. */
  readonly step: number;

  constructor(mesh: Mesh) {
    this.origin = mesh.origin;
    const total = mesh.groups.reduce((sum, group) => sum + group.indices.length / 3, 0);
    const corners = new Float64Array(9 * total);
    let place = 0;
    let largest = 1;
    for (const group of mesh.groups) {
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

  /** Whether nothing is between two points. */
  free(from: Vec3, to: Vec3): boolean {
    const apart = sub(to, from);
    const distance = length(apart);
    return distance <= 2 * this.step || !this.bvh.cast(from, unit(apart), this.step, distance - this.step);
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
