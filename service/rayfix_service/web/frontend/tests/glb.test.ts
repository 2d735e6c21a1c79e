import { describe, expect, test } from "vitest";

import { readGlb } from "../src/scene/glb";

const FLOATS = [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1];
const FIRST = [0, 1, 2, 0, 1, 3];
const SECOND = [1, 2, 3];

/** Binary glTF as the service writes it, with the data that a test wants. */
function glb(document: object, binary: ArrayBuffer, magic = 0x46546c67): ArrayBuffer {
  const text = new TextEncoder().encode(JSON.stringify(document));
  const padded = new Uint8Array(4 * Math.ceil(text.length / 4)).fill(0x20);
  padded.set(text);
  const data = new ArrayBuffer(12 + 8 + padded.length + 8 + binary.byteLength);
  const view = new DataView(data);
  [magic, 2, data.byteLength, padded.length, 0x4e4f534a].forEach((value, n) => view.setUint32(4 * n, value, true));
  new Uint8Array(data).set(padded, 20);
  view.setUint32(20 + padded.length, binary.byteLength, true);
  view.setUint32(24 + padded.length, 0x004e4942, true);
  new Uint8Array(data).set(new Uint8Array(binary), 28 + padded.length);
  return data;
}

const DOCUMENT = {
  nodes: [{ children: [1] }, { mesh: 0, translation: [10, 20, 30] }],
  meshes: [
    {
      primitives: [
        { attributes: { POSITION: 0 }, indices: 1, material: 0 },
        { attributes: { POSITION: 0 }, indices: 2, material: 1 },
      ],
    },
  ],
  materials: [
    { name: "concrete", pbrMetallicRoughness: { baseColorFactor: [0.5, 0.25, 0.125, 1] } },
    { name: "glass", pbrMetallicRoughness: { baseColorFactor: [0, 0.5, 1, 1] } },
  ],
  accessors: [
    { bufferView: 0, count: 4 },
    { bufferView: 1, count: 6 },
    { bufferView: 2, count: 3 },
  ],
  bufferViews: [
    { byteOffset: 0, byteLength: 48 },
    { byteOffset: 48, byteLength: 24 },
    { byteOffset: 72, byteLength: 12 },
  ],
};
const BINARY = new Uint8Array([
  ...new Uint8Array(new Float32Array(FLOATS).buffer),
  ...new Uint8Array(new Uint32Array([...FIRST, ...SECOND]).buffer),
]).buffer;

describe("binary glTF", () => {
  test("gives positions, the origin and a group for each material", () => {
    const mesh = readGlb(glb(DOCUMENT, BINARY));
    expect([...mesh.positions]).toEqual(FLOATS);
    expect(mesh.origin).toEqual([10, 20, 30]);
    expect(mesh.groups.map((group) => [group.material, group.colour, [...group.indices]])).toEqual([
      ["concrete", [0.5, 0.25, 0.125], FIRST],
      ["glass", [0, 0.5, 1], SECOND],
    ]);
  });

  test("without a translation has its origin in that of the scene", () => {
    const mesh = readGlb(glb({ ...DOCUMENT, nodes: [{ mesh: 0 }] }, BINARY));
    expect(mesh.origin).toEqual([0, 0, 0]);
  });

  test("is refused when it is something else", () => {
    expect(() => readGlb(glb(DOCUMENT, BINARY, 1))).toThrow("not binary glTF");
    expect(() => readGlb(new ArrayBuffer(8))).toThrow("not binary glTF");
    expect(() => readGlb(new TextEncoder().encode("<html>an error page of a proxy</html>").buffer)).toThrow("not binary glTF");
  });
});
