// What of a scene's mesh is drawn: the inside of the detection box, or what surrounds it.

import { Box3, Matrix4, Quaternion, Vector3 } from '../vendor/three.bundle.min.js';

const REACH = 0.8; // how far the surroundings reach beyond the box, in halves of its longest side
const NONE = { center: [0, 0, 0], quaternion: [0, 0, 0, 1], outer: [0, 0, 0], inner: [0, 0, 0] };

const halves = (box) => box.size.map((side) => side / 2);

/** What lies in the detection box { center, size, quaternion }. */
export const insideOf = (box) => ({ ...box, outer: halves(box), inner: [0, 0, 0] });

/** What lies near it, but not in it. */
export function surroundingsOf(box) {
  const inner = halves(box);
  const reach = REACH * Math.max(...inner);
  return { ...box, outer: inner.map((half) => half + reach), inner };
}

/** The uniforms of the shader of surface.js. */
export function clipUniforms(clip) {
  const { center, quaternion, outer, inner } = clip ?? NONE;
  const turn = new Matrix4().makeRotationFromQuaternion(new Quaternion(...quaternion).normalize().invert()).elements;
  return {
    uCenter: { value: new Vector3(...center) },
    uTurn: { value: [turn[0], turn[1], turn[2], turn[4], turn[5], turn[6], turn[8], turn[9], turn[10]] },
    uOuter: { value: new Vector3(...outer) },
    uInner: { value: new Vector3(...inner) },
  };
}

/** The same triangles, with the bounds of what is drawn of them: the view is framed by those. */
export function clippedGeometry(geometry, { center, quaternion, outer }) {
  const made = geometry.clone();
  const corners = [];
  const turn = new Quaternion(...quaternion).normalize();
  for (const x of [-1, 1]) for (const y of [-1, 1]) for (const z of [-1, 1]) {
    corners.push(new Vector3(x * outer[0], y * outer[1], z * outer[2]).applyQuaternion(turn).add(new Vector3(...center)));
  }
  made.boundingBox = new Box3().setFromPoints(corners).intersect(geometry.boundingBox);
  return made;
}
