// Evenly spread samples of a surface, with heights along its up axis: what a click's thing is found from.

const SAMPLES = 120_000;
const VOXELS_ACROSS = 160;
const UP = { x: [0, 1], y: [1, 1], z: [2, 1], '-x': [0, -1], '-y': [1, -1], '-z': [2, -1] };

/** [axis, sign] of an up axis, and the two axes across. */
export function axesOf(up) {
  const [axis, sign] = UP[up];
  return { axis, sign, u: (axis + 1) % 3, v: (axis + 2) % 3 };
}

/**
 * { count, u, v, height, level, angle, area, voxel, low, high } of a geometry: coordinates across and along the up axis,
 * |cosine| between normal and up, the normal's direction across in 0..pi, the area that each sample stands for, and a
 * length that neighboring samples keep within.
 */
export function samplesOf(geometry, up) {
  const { axis, sign, u, v } = axesOf(up);
  const at = geometry.getAttribute('position').array;
  const corners = geometry.index.array;
  const areas = areasOf(at, corners);
  const total = areas.reduce((sum, area) => sum + area, 0) || 1;
  const found = { u: [], v: [], height: [], level: [], angle: [] };
  let due = 0;
  let drawn = 0;
  for (let t = 0; t < areas.length; t += 1) {
    due += (areas[t] / total) * SAMPLES;
    const normal = normalOf(at, corners, t);
    for (; due >= 1; due -= 1) {
      drawn += 1;
      const point = pointIn(at, corners, t, drawn);
      found.u.push(point[u]);
      found.v.push(point[v]);
      found.height.push(sign * point[axis]);
      found.level.push(Math.abs(normal[axis]));
      found.angle.push((Math.atan2(normal[v], normal[u]) + Math.PI) % Math.PI);
    }
  }
  const box = geometry.boundingBox;
  const size = box.max.toArray().map((high, i) => high - box.min.toArray()[i]);
  const area = total / SAMPLES;
  const voxel = Math.max(Math.hypot(...size) / VOXELS_ACROSS, 2.5 * Math.sqrt(area));
  return { ...found, count: found.u.length, area, voxel, across: [size[u], size[v]], tall: size[axis] };
}

function areasOf(at, corners) {
  const areas = new Float64Array(corners.length / 3);
  for (let t = 0; t < areas.length; t += 1) areas[t] = Math.hypot(...cross(at, corners, t)) / 2;
  return areas;
}

function normalOf(at, corners, t) {
  const normal = cross(at, corners, t);
  const length = Math.hypot(...normal) || 1;
  return normal.map((part) => part / length);
}

function cross(at, corners, t) {
  const [a, b, c] = [0, 1, 2].map((k) => 3 * corners[3 * t + k]);
  const [px, py, pz] = [at[b] - at[a], at[b + 1] - at[a + 1], at[b + 2] - at[a + 2]];
  const [qx, qy, qz] = [at[c] - at[a], at[c + 1] - at[a + 1], at[c + 2] - at[a + 2]];
  return [py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx];
}

/** The n-th of a series of points that fill a triangle evenly (Roberts' R2 sequence, folded). */
function pointIn(at, corners, t, n) {
  let x = (0.5 + n * 0.7548776662466927) % 1;
  let y = (0.5 + n * 0.5698402909980532) % 1;
  if (x + y > 1) [x, y] = [1 - x, 1 - y];
  const [a, b, c] = [0, 1, 2].map((k) => 3 * corners[3 * t + k]);
  return [0, 1, 2].map((i) => at[a + i] + x * (at[b + i] - at[a + i]) + y * (at[c + i] - at[a + i]));
}
