// A faint grid under everything, fading out, so that the eye finds the ground.

import { DoubleSide, Mesh, PlaneGeometry, ShaderMaterial, Color, Vector3 } from '../vendor/three.bundle.min.js';

const VERTEX = /* glsl */ `
  varying vec2 vAt;
  void main() {
    vAt = position.xy;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  }
`;

const FRAGMENT = /* glsl */ `
  uniform vec3 uTint;
  uniform float uCell;
  uniform float uReach;
  varying vec2 vAt;
  float lines(float cell, float width) {
    vec2 at = vAt / cell;
    vec2 wide = fwidth(at);
    vec2 near = abs(fract(at - 0.5) - 0.5) / max(wide, vec2(1e-6));
    float line = 1.0 - min(min(near.x, near.y) / width, 1.0);
    return line * (1.0 - smoothstep(0.15, 0.6, max(wide.x, wide.y)));   // no moiré far away
  }
  void main() {
    float fade = 1.0 - smoothstep(0.25, 1.0, length(vAt) / uReach);
    float strength = max(0.30 * lines(uCell, 1.0), 0.55 * lines(uCell * 5.0, 1.2));
    gl_FragColor = vec4(uTint, strength * fade);
    if (gl_FragColor.a < 0.004) discard;
  }
`;

/** A horizontal grid (three.js's y is up) whose cells are a round number of units. */
export class Floor {
  constructor() {
    this.material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      transparent: true,
      depthWrite: false,
      side: DoubleSide,
      uniforms: { uTint: { value: new Color() }, uCell: { value: 1 }, uReach: { value: 1 } },
    });
    this.mesh = new Mesh(new PlaneGeometry(1, 1), this.material);
    this.mesh.rotation.x = -Math.PI / 2;
    this.mesh.visible = false;
  }

  /** Lies under the box, reaching `reach` to every side of its center. */
  place(box, reach) {
    const center = box.getCenter(new Vector3());
    this.mesh.geometry.dispose();
    this.mesh.geometry = new PlaneGeometry(2 * reach, 2 * reach);
    this.mesh.position.set(center.x, box.min.y - reach * 2e-3, center.z);
    this.material.uniforms.uReach.value = reach;
    this.material.uniforms.uCell.value = roundCell(reach / 10);
    this.mesh.visible = true;
  }

  tint(color) {
    this.material.uniforms.uTint.value.copy(color);
  }
}

/** The largest of 1, 2 and 5 times a power of ten that is at most `length`. */
function roundCell(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].map((digit) => digit * power).find((cell) => cell <= length) ?? power;
}
