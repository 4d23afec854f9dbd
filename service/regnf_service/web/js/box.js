// The detection box as a wire frame.

import {
  BoxGeometry, EdgesGeometry, LineBasicMaterial, LineSegments, Quaternion, Vector3,
} from '../vendor/three.bundle.min.js';

/** box: { center, size, quaternion } in the scene frame. Its hidden edges shine through faintly. */
export function wireBox({ center, size, quaternion }) {
  const edges = new EdgesGeometry(new BoxGeometry(...size));
  const material = new LineBasicMaterial({ toneMapped: false, transparent: true, opacity: 0.95 });
  const lines = new LineSegments(edges, material);
  const hidden = material.clone();
  Object.assign(hidden, { opacity: 0.3, depthTest: false, depthWrite: false, color: material.color });
  lines.add(new LineSegments(edges, hidden));
  lines.position.copy(new Vector3(...center));
  lines.quaternion.copy(new Quaternion(...quaternion).normalize());
  return lines;
}
