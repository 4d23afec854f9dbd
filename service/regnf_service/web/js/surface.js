// A surface as a shaded mesh: flat where the mesh has no normals, colored where it has colors.

import { Color, DoubleSide, Mesh, ShaderMaterial } from '../vendor/three.bundle.min.js';
import { clipUniforms } from './clip.js';

const VERTEX = /* glsl */ `
  attribute vec4 aColor;
  varying vec3 vColor;
  varying vec3 vNormal;
  varying vec3 vAt;
  varying vec3 vPlace;
  void main() {
    vPlace = position;
    vec4 view = modelViewMatrix * vec4(position, 1.0);
    vAt = view.xyz;
    vNormal = normalMatrix * normal;
    vColor = aColor.rgb;
    gl_Position = projectionMatrix * view;
  }
`;

const FRAGMENT = /* glsl */ `
  uniform vec3 uTint;
  uniform bool uColored;
  uniform bool uFlat;
  uniform float uOpacity;
  uniform bool uClipped; // only what lies in a box is drawn, and not in another one about the same center
  uniform vec3 uCenter;
  uniform mat3 uTurn;    // from the surface's frame to the boxes'
  uniform vec3 uOuter;   // half sizes
  uniform vec3 uInner;
  uniform bool uOpen;   // what is seen from inside matter is left out: walls before the camera
  varying vec3 vColor;
  varying vec3 vNormal;
  varying vec3 vAt;
  varying vec3 vPlace;
  void main() {
    if (uClipped) {
      vec3 from = abs(uTurn * (vPlace - uCenter));
      if (any(greaterThan(from, uOuter)) || all(lessThan(from, uInner))) discard;
    }
    vec3 n = uFlat ? cross(dFdx(vAt), dFdy(vAt)) : vNormal;
    n = normalize(n);
    if (uOpen && !gl_FrontFacing) discard;
    if (dot(n, -vAt) < 0.0) n = -n;
    float key = max(dot(n, normalize(vec3(0.45, 0.75, 0.6))), 0.0);
    float fill = max(dot(n, normalize(vec3(-0.7, 0.1, 0.5))), 0.0);
    vec3 base = uColored ? vColor : uTint;
    gl_FragColor = vec4(base * (0.55 + 0.42 * key + 0.14 * fill), uOpacity);
  }
`;

/** Has what a Cloud has, so that the viewer treats both alike. */
export class Surface {
  /**
   * open leaves out surfaces seen from behind, as a room's walls from outside: triangles face free space. plain leaves
   * its colors out; nearer: of two surfaces in one place this one is seen; clip as clip.js makes it: what is drawn.
   */
  constructor(geometry, { opacity = 1, open = false, plain = false, nearer = false, clip = null } = {}) {
    this.material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: DoubleSide,
      transparent: opacity < 1,
      depthWrite: opacity === 1,
      polygonOffset: nearer,
      polygonOffsetFactor: -2,
      polygonOffsetUnits: -4,
      uniforms: {
        uTint: { value: new Color() },
        uColored: { value: Boolean(geometry.getAttribute('aColor')) && !plain },
        uFlat: { value: !geometry.getAttribute('normal') },
        uOpacity: { value: opacity },
        uOpen: { value: open },
        uClipped: { value: clip !== null },
        ...clipUniforms(clip),
      },
    });
    this.points = new Mesh(geometry, this.material);
    this.points.renderOrder = opacity < 1 ? 1 : 0;
    this.points.matrixAutoUpdate = false;
  }

  get geometry() {
    return this.points.geometry;
  }

  set geometry(other) {
    this.points.geometry = other;
  }

  /** Where the surface's own frame lies in the scene's. */
  place(matrix) {
    this.points.matrix.copy(matrix);
    this.points.matrixWorldNeedsUpdate = true;
  }

  tint(color) {
    this.material.uniforms.uTint.value.copy(color);
  }

  /** mode as the page's choice has it; residuals are colors of samples, not of meshes. */
  colorBy(mode) {
    this.material.uniforms.uColored.value = mode === 'file' && Boolean(this.geometry.getAttribute('aColor'));
  }

  resize() {} // only points have a size of their own
}

/** Whether the triangles agree in facing the surface's middle, as a room's, or in facing away from it. */
export function isOriented(geometry) {
  const at = geometry.getAttribute('position').array;
  const corners = geometry.index.array;
  const middle = geometry.boundingSphere.center.toArray();
  let [sum, all] = [0, 0];
  for (let t = 0; t < corners.length; t += 3) {
    const [a, b, c] = [3 * corners[t], 3 * corners[t + 1], 3 * corners[t + 2]];
    const [px, py, pz] = [at[b] - at[a], at[b + 1] - at[a + 1], at[b + 2] - at[a + 2]];
    const [qx, qy, qz] = [at[c] - at[a], at[c + 1] - at[a + 1], at[c + 2] - at[a + 2]];
    const towards = [middle[0] - at[a], middle[1] - at[a + 1], middle[2] - at[a + 2]];
    const volume = (py * qz - pz * qy) * towards[0] + (pz * qx - px * qz) * towards[1] + (px * qy - py * qx) * towards[2];
    sum += volume;
    all += Math.abs(volume);
  }
  return Math.abs(sum) > 0.2 * all;
}
