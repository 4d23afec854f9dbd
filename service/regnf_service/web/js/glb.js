// Reading the GLB files that the service writes: one mesh, positions, perhaps normals and colors, indices.

import { BufferAttribute, BufferGeometry } from '../vendor/three.bundle.min.js';

const TYPES = { 5126: Float32Array, 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array };
const WIDTHS = { SCALAR: 1, VEC3: 3, VEC4: 4 };
const NAMES = { POSITION: 'position', NORMAL: 'normal', COLOR_0: 'aColor' };

/** A geometry from the bytes of a GLB file. Raises Error on what the service does not write. */
export function geometryFromGlb(buffer) {
  const view = new DataView(buffer);
  if (view.getUint32(0, true) !== 0x46546c67) throw new Error('the service did not send a mesh');
  const length = view.getUint32(12, true);
  const document = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
  const start = 28 + length;
  const read = (number) => {
    const { bufferView, componentType, count, type, normalized } = document.accessors[number];
    const values = new TYPES[componentType](buffer, start + document.bufferViews[bufferView].byteOffset, count * WIDTHS[type]);
    return new BufferAttribute(values, WIDTHS[type], normalized);
  };
  const { attributes, indices } = document.meshes[0].primitives[0];
  const geometry = new BufferGeometry();
  for (const [name, number] of Object.entries(attributes)) if (NAMES[name]) geometry.setAttribute(NAMES[name], read(number));
  geometry.setIndex(read(indices));
  const { matrix } = document.nodes[0]; // of a mesh far from the origin: a shift
  if (matrix) geometry.translate(...matrix.slice(12, 15));
  geometry.computeBoundingSphere();
  geometry.computeBoundingBox();
  return geometry;
}
