// Where the camera stands: framing a sphere, choosing an open side, and moving by keys.

import { Spherical, Vector3 } from '../vendor/three.bundle.min.js';

const ELEVATION = 0.42; // radians above the horizon
const TURN = Math.PI / 24;
const CANDIDATES = 16;

/** Puts camera and controls so that the sphere fills the view, seen from `direction` (unit, towards the camera). */
export function frameSphere(camera, controls, sphere, direction) {
  const half = (camera.fov * Math.PI) / 360;
  const narrow = Math.min(half, Math.atan(Math.tan(half) * camera.aspect));
  const distance = (sphere.radius / Math.sin(narrow)) * 1.2;
  controls.target.copy(sphere.center);
  camera.position.copy(sphere.center).addScaledVector(direction, distance);
  controls.minDistance = sphere.radius * 0.1;
  controls.maxDistance = distance * 20;
  controls.update();
}

/** The direction to look from: the side on which the fewest points stand between the camera and the sphere. */
export function clearestDirection(sphere, positions, toWorld, elevation = ELEVATION) {
  const blocked = new Array(CANDIDATES).fill(0);
  const sides = blocked.map((_, i) => horizonDirection(Math.PI / 5 + (i * 2 * Math.PI) / CANDIDATES, elevation));
  const point = new Vector3();
  const stride = Math.max(Math.floor(positions.count / 4000), 1);
  for (let i = 0; i < positions.count; i += stride) {
    point.fromBufferAttribute(positions, i).applyMatrix4(toWorld).sub(sphere.center);
    const square = point.lengthSq();
    sides.forEach((side, k) => {
      const along = point.dot(side);
      const aside = square - along * along;
      if (along > sphere.radius * 0.6 && aside < sphere.radius ** 2 * 0.8) blocked[k] += 1;
    });
  }
  return sides[blocked.indexOf(Math.min(...blocked))];
}

/** Arrow keys, plus, minus and Home on the focused canvas. Returns true when the key was one of them. */
export function moveByKey(event, camera, controls, reset) {
  const { key, shiftKey } = event;
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  if (key in arrows) (shiftKey ? pan : orbit)(camera, controls, ...arrows[key]);
  else if (key === '+' || key === '=') zoom(camera, controls, 1 / 1.15);
  else if (key === '-' || key === '_') zoom(camera, controls, 1.15);
  else if (key === 'Home' || key === '0') reset();
  else return false;
  controls.update();
  return true;
}

function orbit(camera, controls, right, up) {
  const at = new Spherical().setFromVector3(camera.position.clone().sub(controls.target));
  at.theta += right * TURN;
  at.phi -= up * TURN;
  at.makeSafe();
  camera.position.setFromSpherical(at).add(controls.target);
}

function pan(camera, controls, right, up) {
  const step = camera.position.distanceTo(controls.target) / 20;
  const [x, y] = [new Vector3(), new Vector3()];
  camera.matrix.extractBasis(x, y, new Vector3());
  const move = x.multiplyScalar(right * step).addScaledVector(y, up * step);
  camera.position.add(move);
  controls.target.add(move);
}

function zoom(camera, controls, factor) {
  camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target);
}

function horizonDirection(azimuth, elevation) {
  return new Vector3(
    Math.cos(elevation) * Math.cos(azimuth), Math.sin(elevation), Math.cos(elevation) * Math.sin(azimuth),
  );
}
