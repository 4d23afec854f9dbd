// Where the object's center may be: an ellipsoid that holds it with 95 % probability, by the pose's covariance.

import {
  BufferAttribute, BufferGeometry, LineBasicMaterial, LineSegments, Matrix4,
} from '../vendor/three.bundle.min.js';

const QUANTILE = 7.8147; // of chi-square with three degrees of freedom, for 95 %
const VISIBLE = 0.1; // of the object's diameter: the least length of the longest half-axis as it is drawn
const [MERIDIANS, PARALLELS, STEPS] = [8, 7, 64];

/**
 * The covariance of the place of a point, 3x3 in the object's frame and units. covariance: 7x7 of T_object_scene, x -> s R x + t,
 * in the order (rotation, translation, log scale): s exp(log scale), exp(rotation) R, t + translation. point: in the object's
 * frame; shift: t. Seen in the scene, the point moves by -(rotation x arm + translation + log scale * arm) with
 * arm = point - t, to first order and in the object's frame. null where a number is missing, as that of a rotation nothing
 * tells.
 */
export function covarianceOfPlace(covariance, point, shift) {
  if (!covariance?.flat().every(Number.isFinite) || covariance.length !== 7) return null;
  const [x, y, z] = point.map((value, i) => value - shift[i]);
  const jacobian = [[0, z, -y, 1, 0, 0, x], [-z, 0, x, 0, 1, 0, y], [y, -x, 0, 0, 0, 1, z]];
  const half = product(jacobian, covariance);
  return half.map((row) => jacobian.map((column) => dot(row, column)));
}

/**
 * { object, factor }: the ellipsoid as lines in the object's frame, enlarged by factor, a power of ten, so that it can be
 * seen; or null where nothing is known. shift: of T_object_scene; diameter: the object's.
 */
export function ellipsoidOf(covariance, center, shift, diameter) {
  const spread = covarianceOfPlace(covariance, center, shift);
  if (!spread || !(diameter > 0)) return null;
  const longest = Math.sqrt(QUANTILE * largestEigenvalue(spread));
  if (!(longest > 0)) return null;
  const factor = 10 ** Math.max(0, Math.ceil(Math.log10((VISIBLE * diameter) / longest)));
  const root = cholesky(spread).map((row) => row.map((value) => value * factor * Math.sqrt(QUANTILE)));
  const [a, b, c] = root.map((row, i) => [...row, center[i]]);
  const geometry = new BufferGeometry().setAttribute('position', new BufferAttribute(sphereLines(), 3));
  geometry.applyMatrix4(new Matrix4().set(...a, ...b, ...c, 0, 0, 0, 1));
  const material = new LineBasicMaterial({ toneMapped: false, transparent: true, opacity: 0.9, depthTest: false });
  const object = new LineSegments(geometry, material);
  object.matrixAutoUpdate = false;
  object.renderOrder = 1; // over the object that hides it
  return { object, factor };
}

/** The lower triangular root of a positive semidefinite matrix: of the unit sphere it makes the ellipsoid. */
function cholesky(matrix) {
  const root = matrix.map((row) => row.map(() => 0));
  for (let i = 0; i < matrix.length; i += 1) {
    for (let j = 0; j <= i; j += 1) {
      const rest = matrix[i][j] - dot(root[i].slice(0, j), root[j].slice(0, j));
      if (i === j) root[i][i] = Math.sqrt(Math.max(0, rest));
      else root[i][j] = root[j][j] > 0 ? rest / root[j][j] : 0;
    }
  }
  return root;
}

/** By powers of the matrix, each divided by its trace: 2^6 of them leave the largest alone. */
function largestEigenvalue(matrix) {
  let power = matrix;
  for (let i = 0; i < 6; i += 1) {
    const trace = power[0][0] + power[1][1] + power[2][2];
    if (!(trace > 0)) return 0;
    const scaled = power.map((row) => row.map((value) => value / trace));
    power = product(scaled, scaled);
  }
  const shares = product(power, matrix);
  return (shares[0][0] + shares[1][1] + shares[2][2]) / (power[0][0] + power[1][1] + power[2][2]);
}

/** Meridians and parallels of the unit sphere, as pairs of ends. */
function sphereLines() {
  const ends = [];
  const circle = (point) => {
    for (let i = 0; i < STEPS; i += 1) ends.push(...point((2 * Math.PI * i) / STEPS), ...point((2 * Math.PI * (i + 1)) / STEPS));
  };
  for (let i = 0; i < MERIDIANS; i += 1) {
    const turn = (Math.PI * i) / MERIDIANS;
    circle((t) => [Math.cos(turn) * Math.cos(t), Math.sin(turn) * Math.cos(t), Math.sin(t)]);
  }
  for (let i = 1; i <= PARALLELS; i += 1) {
    const height = Math.cos((Math.PI * i) / (PARALLELS + 1));
    const radius = Math.sqrt(1 - height * height);
    circle((t) => [radius * Math.cos(t), radius * Math.sin(t), height]);
  }
  return new Float32Array(ends);
}

const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const product = (a, b) => a.map((row) => b[0].map((_, j) => row.reduce((sum, value, k) => sum + value * b[k][j], 0)));
