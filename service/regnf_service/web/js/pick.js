// The ray under the pointer, and where it meets a surface.

import { Vector3 } from '../vendor/three.bundle.min.js';

/** { origin, direction } in the scene's frame. */
export function rayAt(event, viewer) {
  const { left, top, width, height } = viewer.renderer.domElement.getBoundingClientRect();
  const x = ((event.clientX - left) / width) * 2 - 1;
  const y = 1 - ((event.clientY - top) / height) * 2;
  const far = viewer.frame.worldToLocal(new Vector3(x, y, 0.5).unproject(viewer.camera));
  const origin = viewer.frame.worldToLocal(viewer.camera.position.clone());
  return { origin: origin.toArray(), direction: far.sub(origin).normalize().toArray() };
}

/** Where a ray first meets a geometry, as [x, y, z]; null where it does not. skip(facing) leaves out triangles. */
export function firstHit(geometry, { origin, direction }, skip = () => false) {
  const at = geometry.getAttribute('position').array;
  const corners = geometry.index.array;
  let least = Infinity;
  const [dx, dy, dz] = direction;
  for (let t = 0; t < corners.length; t += 3) {
    const [a, b, c] = [3 * corners[t], 3 * corners[t + 1], 3 * corners[t + 2]];
    const [px, py, pz] = [at[b] - at[a], at[b + 1] - at[a + 1], at[b + 2] - at[a + 2]];
    const [qx, qy, qz] = [at[c] - at[a], at[c + 1] - at[a + 1], at[c + 2] - at[a + 2]];
    const [nx, ny, nz] = [dy * qz - dz * qy, dz * qx - dx * qz, dx * qy - dy * qx];
    const volume = px * nx + py * ny + pz * nz; // Möller and Trumbore 1997
    if (Math.abs(volume) < 1e-18 || skip(volume)) continue;
    const [ox, oy, oz] = [origin[0] - at[a], origin[1] - at[a + 1], origin[2] - at[a + 2]];
    const u = (ox * nx + oy * ny + oz * nz) / volume;
    if (u < 0 || u > 1) continue;
    const [mx, my, mz] = [oy * pz - oz * py, oz * px - ox * pz, ox * py - oy * px];
    const v = (dx * mx + dy * my + dz * mz) / volume;
    if (v < 0 || u + v > 1) continue;
    const far = (qx * mx + qy * my + qz * mz) / volume;
    if (far > 1e-6 && far < least) least = far;
  }
  return least === Infinity ? null : origin.map((part, i) => part + least * direction[i]);
}

/** Where a ray meets the plane through `point` across `normal`; null where it runs along it. */
export function onPlane({ origin, direction }, point, normal) {
  const slope = dot(direction, normal);
  if (Math.abs(slope) < 1e-6) return null;
  const far = dot(point.map((part, i) => part - origin[i]), normal) / slope;
  return far > 0 ? origin.map((part, i) => part + far * direction[i]) : null;
}

/** How far along the line from `point` in `axis` the nearest place to the ray is. */
export function alongLine({ origin, direction }, point, axis) {
  const apart = point.map((part, i) => part - origin[i]);
  const b = dot(axis, direction);
  const rest = 1 - b * b;
  return rest < 1e-6 ? null : (b * dot(direction, apart) - dot(axis, apart)) / rest;
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
