/** Reads the service's own binary glTF: one mesh, a primitive for each material, below two nodes. */

import type { Mesh, Vec3 } from "../types";

interface Gltf {
  nodes: { translation?: Vec3; mesh?: number }[];
  meshes: { primitives: { attributes: { POSITION: number }; indices: number; material: number }[] }[];
  materials: { name: string; pbrMetallicRoughness: { baseColorFactor: number[] } }[];
  accessors: { bufferView: number; count: number }[];
  bufferViews: { byteOffset: number; byteLength: number }[];
}

const MAGIC = 0x46546c67; // "glTF"

export function readGlb(data: ArrayBuffer): Mesh {
  const view = new DataView(data);
  if (data.byteLength < 20 || view.getUint32(0, true) !== MAGIC) throw new Error("the scene is not binary glTF");
  const length = view.getUint32(12, true);
  const gltf = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 20, length))) as Gltf;
  const begin = 20 + length + 8;
  const slice = (accessor: number, numbers: number): ArrayBuffer => {
    const { bufferView, count } = gltf.accessors[accessor]!;
    const at = begin + gltf.bufferViews[bufferView]!.byteOffset;
    return data.slice(at, at + 4 * count * numbers);
  };
  const { primitives } = gltf.meshes[0]!;
  const node = gltf.nodes.find((n) => n.mesh === 0);
  return {
    positions: new Float32Array(slice(primitives[0]!.attributes.POSITION, 3)),
    origin: node?.translation ?? [0, 0, 0],
    groups: primitives.map((primitive) => {
      const material = gltf.materials[primitive.material]!;
      return {
        material: material.name,
        colour: material.pbrMetallicRoughness.baseColorFactor.slice(0, 3) as unknown as Vec3,
        indices: new Uint32Array(slice(primitive.indices, 1)),
      };
    }),
  };
}
