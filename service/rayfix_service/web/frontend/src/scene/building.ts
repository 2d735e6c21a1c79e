/** The twin: floor, walls, ceiling and objects, each with an opacity of its own. */

import {
  Box3,
  BufferAttribute,
  BufferGeometry,
  Color,
  DoubleSide,
  EdgesGeometry,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh as ThreeMesh,
  MeshLambertMaterial,
  Vector3,
  type Plane,
} from "three";

import { theme } from "../theme";
import type { Mesh, Vec3 } from "../types";

export type Part = "floor" | "walls" | "ceiling" | "objects";

export const PARTS: readonly Part[] = ["floor", "walls", "ceiling", "objects"];

const OPACITY: Record<Part, number> = { floor: 1, walls: 0.14, ceiling: 0, objects: 0.85 };
const EDGE_ANGLE = 25; // degrees
const WALL = 0.15; // of the building's length: a narrower face from floor to ceiling is a pillar's or a machine's

interface Surface {
  part: Part;
  colour: Vec3;
  mesh: ThreeMesh<BufferGeometry, MeshLambertMaterial>;
}

export class Building {
  readonly group = new Group();
  readonly bounds = new Box3();
  private readonly surfaces: Surface[] = [];
  private readonly edges = new Map<Part, LineSegments<BufferGeometry, LineBasicMaterial>>();
  private readonly opacity = { ...OPACITY };

  constructor(
    mesh: Mesh,
    private readonly section: Plane,
  ) {
    const positions = new BufferAttribute(mesh.positions, 3);
    this.bounds.setFromBufferAttribute(positions);
    for (const { colour, indices } of mesh.groups) {
      for (const [part, chosen] of split(mesh.positions, indices, this.bounds)) {
        const geometry = new BufferGeometry();
        geometry.setAttribute("position", positions);
        geometry.setIndex(new BufferAttribute(chosen, 1));
        const flat = geometry.toNonIndexed();
        flat.computeVertexNormals();
        const material = new MeshLambertMaterial({
          side: DoubleSide,
          clippingPlanes: [section],
          polygonOffset: true,
          polygonOffsetFactor: 1,
          polygonOffsetUnits: 1,
        });
        const surface = { part, colour, mesh: new ThreeMesh(flat, material) };
        this.surfaces.push(surface);
        this.group.add(surface.mesh);
      }
    }
    theme.onChange(() => this.paint());
    this.paint();
  }

  /** Lines along the edges; worth a moment in a large scene, so after the first picture. */
  addEdges(mesh: Mesh): void {
    const chosen = new Map<Part, number[]>();
    for (const { indices } of mesh.groups) {
      for (const [part, some] of split(mesh.positions, indices, this.bounds)) {
        const list = chosen.get(part) ?? [];
        for (const index of some) list.push(index);
        chosen.set(part, list);
      }
    }
    for (const [part, list] of chosen) {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(mesh.positions, 3));
      geometry.setIndex(list);
      const material = new LineBasicMaterial({ transparent: true, clippingPlanes: [this.section], depthWrite: false });
      const lines = new LineSegments(new EdgesGeometry(geometry, EDGE_ANGLE), material);
      this.edges.set(part, lines);
      this.group.add(lines);
    }
    this.paint();
  }

  getOpacity(part: Part): number {
    return this.opacity[part];
  }

  setOpacity(part: Part, value: number): void {
    this.opacity[part] = value;
    this.paint();
  }

  private paint(): void {
    const { palette } = theme;
    for (const { part, colour, mesh } of this.surfaces) {
      const { material } = mesh;
      if (part === "floor") material.color.set(palette.floor);
      else material.color = new Color().setRGB(...tinted(colour, palette.tint), "srgb");
      const opacity = this.opacity[part];
      mesh.visible = opacity > 0.01;
      material.opacity = opacity;
      material.transparent = opacity < 0.99;
      material.depthWrite = opacity > 0.5;
      material.needsUpdate = true;
      // What can be seen through is drawn after what cannot.
      mesh.renderOrder = material.transparent ? 1 : 0;
    }
    for (const [part, lines] of this.edges) {
      const opacity = this.opacity[part];
      lines.visible = opacity > 0.01;
      lines.material.color.set(palette.edges);
      lines.material.opacity = palette.edgeOpacity * (part === "objects" ? 1 : 0.7) * (0.35 + 0.65 * opacity);
    }
  }
}

const tinted = (colour: Vec3, tint: Vec3): [number, number, number] => [
  Math.min(1, colour[0] * tint[0]),
  Math.min(1, colour[1] * tint[1]),
  Math.min(1, colour[2] * tint[2]),
];

const wide = (a: Vector3, b: Vector3, c: Vector3): number =>
  Math.max(Math.hypot(a.x - b.x, a.y - b.y), Math.hypot(b.x - c.x, b.y - c.y), Math.hypot(c.x - a.x, c.y - a.y));

/** Sort triangles by where they are and how they stand. */
function split(positions: Float32Array, indices: Uint32Array, bounds: Box3): Map<Part, Uint32Array> {
  const { min, max } = bounds;
  const extent = bounds.getSize(new Vector3());
  const lists = new Map<Part, number[]>();
  const [a, b, c] = [new Vector3(), new Vector3(), new Vector3()];
  const normal = new Vector3();
  for (let n = 0; n < indices.length; n += 3) {
    a.fromArray(positions, 3 * indices[n]!);
    b.fromArray(positions, 3 * indices[n + 1]!);
    c.fromArray(positions, 3 * indices[n + 2]!);
    const low = Math.min(a.z, b.z, c.z);
    const high = Math.max(a.z, b.z, c.z);
    normal.copy(b).sub(a).cross(c.clone().sub(a)).normalize();
    const upright = Math.abs(normal.z) < 0.35;
    const onSide = (["x", "y"] as const).some((axis) => {
      const slack = 0.02 * extent[axis];
      const most = Math.max(a[axis], b[axis], c[axis]);
      const least = Math.min(a[axis], b[axis], c[axis]);
      return most < min[axis] + slack || least > max[axis] - slack;
    });
    let part: Part = "objects";
    // A roof may slope; what is level right below the ceiling is the top of something tall.
    const overhead = Math.abs(normal.z) > 0.95 ? 0.97 : 0.8;
    if (!upright && low > min.z + overhead * extent.z) part = "ceiling";
    else if (!upright && high < min.z + 0.03 * extent.z) part = "floor";
    else if (upright && (onSide || (high - low > 0.9 * extent.z && wide(a, b, c) > WALL * Math.max(extent.x, extent.y)))) part = "walls";
    const list = lists.get(part) ?? [];
    list.push(indices[n]!, indices[n + 1]!, indices[n + 2]!);
    lists.set(part, list);
  }
  return new Map([...lists].map(([part, list]) => [part, Uint32Array.from(list)]));
}
