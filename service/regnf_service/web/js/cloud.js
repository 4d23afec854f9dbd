// One point cloud: geometry from a PLY file or from arrays, and the material that draws it.

import {
  BufferAttribute, BufferGeometry, Color, PLYLoader, Points, ShaderMaterial, Sphere,
} from '../vendor/three.bundle.min.js';
import { rampStops } from './colors.js';
import { FRAGMENT, VERTEX } from './shaders.js';

const MODES = { layer: 0, residual: 1, file: 2 };

/** A geometry from the bytes of a PLY file with x y z and, where given, nx ny nz and red green blue. */
export function geometryFromPly(buffer) {
  const geometry = new PLYLoader().parse(buffer);
  if (!geometry.getAttribute('position')?.count) throw new Error('the file has no points');
  const color = geometry.getAttribute('color');
  if (color) geometry.setAttribute('aColor', displayColors(color));
  geometry.computeBoundingSphere();
  return geometry;
}

/** A geometry from flat coordinates (3N) and values 0..1 (N), with the normals of `like` where both hold the same points. */
export function geometryFromArrays(positions, values, like = null) {
  const geometry = new BufferGeometry();
  geometry.setAttribute('position', new BufferAttribute(Float32Array.from(positions), 3));
  geometry.setAttribute('aValue', new BufferAttribute(Float32Array.from(values), 1));
  const normal = like?.getAttribute('normal');
  if (normal && samePoints(positions, like.getAttribute('position'))) geometry.setAttribute('normal', normal);
  geometry.computeBoundingSphere();
  return geometry;
}

function samePoints(flat, attribute) {
  if (flat.length !== attribute.count * 3) return false;
  const tolerance = 1e-4 * (Math.abs(flat[0]) + Math.abs(flat[1]) + Math.abs(flat[2]) + 1e-3);
  const probes = [0, attribute.count >> 1, attribute.count - 1];
  return probes.every((i) => [0, 1, 2].every((k) => Math.abs(flat[i * 3 + k] - attribute.array[i * 3 + k]) < tolerance));
}

/** True when the file's colors say more than one tint would. */
export function isColorful(geometry) {
  const colors = geometry.getAttribute('aColor')?.array ?? [];
  for (let i = 3; i < colors.length; i += 1) {
    if (Math.abs(colors[i] - colors[i % 3]) > 0.02) return true;
  }
  return false;
}

export class Cloud {
  /**
   * opacity below one draws the cloud translucent, without hiding what lies behind it; nearer (in discs) decides
   * which of two clouds in one place is seen; seeThrough leaves out surfaces seen from behind; discs scales their size.
   */
  constructor(geometry, { opacity = 1, nearer = 0, seeThrough = false, discs = 1 } = {}) {
    this.style = { opacity, nearer, seeThrough, discs };
    this.spacing = spacingOf(geometry);
    const translucent = opacity < 1;
    this.material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      transparent: translucent,
      depthWrite: !translucent,
      uniforms: {
        uWorldSize: { value: this.spacing },
        uPixels: { value: 1000 },
        uMinPixels: { value: 1.5 },
        uMode: { value: 0 },
        uTint: { value: new Color() },
        uRamp: { value: rampStops() },
        uLit: { value: Boolean(geometry.getAttribute('normal')) },
        uOpacity: { value: opacity },
        uNearer: { value: nearer },
        uSeeThrough: { value: seeThrough },
      },
    });
    this.points = new Points(geometry, this.material);
    this.points.matrixAutoUpdate = false;
    this.points.renderOrder = translucent ? 1 : 0;
  }

  get geometry() {
    return this.points.geometry;
  }

  /** Where the cloud's own frame lies in the scene's. */
  place(matrix) {
    this.points.matrix.copy(matrix);
    this.points.matrixWorldNeedsUpdate = true;
  }

  tint(color) {
    this.material.uniforms.uTint.value.copy(color);
  }

  /** `factor` scales the discs; 1 just covers the gaps between the samples. */
  resize(factor, pixelsPerUnit, pixelRatio) {
    this.material.uniforms.uWorldSize.value = this.spacing * 1.7 * factor * this.style.discs;
    this.material.uniforms.uPixels.value = pixelsPerUnit;
    this.material.uniforms.uMinPixels.value = 1.4 * factor * pixelRatio;
  }

  colorBy(mode) {
    const has = mode !== 'file' || this.geometry.getAttribute('aColor');
    this.material.uniforms.uMode.value = has ? MODES[mode] : 0;
  }
}

/**
 * The typical distance between neighbors, in the cloud's units: the median over some points of the distance to the
 * fourth nearest, which tells an even cloud's density from a random one's far better than the nearest does.
 */
function spacingOf(geometry) {
  const { array, count } = geometry.getAttribute('position');
  const probes = Math.min(count, 96);
  const stride = Math.max(Math.floor(count / 20_000), 1);
  const fourth = [];
  for (let p = 0; p < probes; p += 1) {
    const squares = fourNearest(array, count, stride, Math.floor((p * count) / probes));
    if (squares[3] < Infinity) fourth.push(Math.sqrt(squares[3] / stride));
  }
  fourth.sort((a, b) => a - b);
  const fallback = (geometry.boundingSphere ?? new Sphere()).radius / 100;
  return fourth[Math.floor(fourth.length / 2)] || fallback || 0.01;
}

/** The four smallest squared distances from point i to others, ascending. */
function fourNearest(array, count, stride, i) {
  const squares = [Infinity, Infinity, Infinity, Infinity];
  for (let j = 0; j < count; j += stride) {
    const [x, y, z] = [array[j * 3] - array[i * 3], array[j * 3 + 1] - array[i * 3 + 1], array[j * 3 + 2] - array[i * 3 + 2]];
    let square = x * x + y * y + z * z;
    if (square === 0 || square >= squares[3]) continue;
    for (let k = 0; k < 4; k += 1) {
      if (square < squares[k]) [squares[k], square] = [square, squares[k]];
    }
  }
  return squares;
}

// The loader takes colors to three.js's linear working space; the shader writes display colors.
function displayColors(attribute) {
  const display = new Float32Array(attribute.count * 3);
  const color = new Color();
  for (let i = 0; i < attribute.count; i += 1) {
    color.setRGB(attribute.getX(i), attribute.getY(i), attribute.getZ(i)).convertLinearToSRGB();
    display.set([color.r, color.g, color.b], i * 3);
  }
  return new BufferAttribute(display, 3);
}
