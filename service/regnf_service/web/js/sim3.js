// Similarity transforms x -> s R x + t, as three.js matrices and as { position, quaternion, scale }.

import { Matrix4, Quaternion, Vector3 } from '../vendor/three.bundle.min.js';

/** A Matrix4 from { matrix }, from four rows, or from sixteen row-major numbers; null when it is none of these. */
export function readSim3(value) {
  const rows = value?.matrix ?? value;
  if (!Array.isArray(rows)) return null;
  const numbers = rows.flat();
  if (numbers.length !== 16 || !numbers.every(Number.isFinite)) return null;
  const matrix = new Matrix4().set(...numbers);
  return Math.abs(matrix.determinant()) > 1e-18 ? matrix : null;
}

export const inverse = (matrix) => matrix.clone().invert();

/** The matrix as four rows of four numbers. */
export function rowsOf(matrix) {
  const [...columns] = matrix.elements;
  return [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => columns[column * 4 + row]));
}

export function partsOf(matrix) {
  const position = new Vector3();
  const quaternion = new Quaternion();
  const scale = new Vector3();
  matrix.decompose(position, quaternion, scale);
  return { position, quaternion, scale: scale.x };
}

/** Between two transforms, share 0..1: translation along the line, rotation along the arc, scale by its logarithm. */
export function between(from, to, share) {
  const a = partsOf(from);
  const b = partsOf(to);
  const scale = Math.exp((1 - share) * Math.log(a.scale) + share * Math.log(b.scale));
  return new Matrix4().compose(
    a.position.lerp(b.position, share),
    a.quaternion.slerp(b.quaternion, share),
    new Vector3(scale, scale, scale),
  );
}
