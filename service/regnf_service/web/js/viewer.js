// The 3D view: clouds, box and floor in the scene's frame, drawn when something has changed and only then.

import {
  Box3, Group, OrbitControls, PerspectiveCamera, Quaternion, Scene, Sphere, Vector3, WebGLRenderer,
} from '../vendor/three.bundle.min.js';
import { clearestDirection, frameSphere, moveByKey } from './camera.js';
import { onThemeChange, themeColor } from './colors.js';
import { Floor } from './floor.js';
import { Gizmo } from './gizmo.js';
import { prefersStillness } from './motion.js';

const UP = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1], '-x': [-1, 0, 0], '-y': [0, -1, 0], '-z': [0, 0, -1] };
const FIELD_OF_VIEW = 36;

export class Viewer {
  /** Throws when the browser offers no WebGL 2. */
  constructor(canvas, gizmoRoot, { antialias = true } = {}) {
    this.renderer = rendererFor(canvas, antialias);
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 1000);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = !prefersStillness();
    this.controls.dampingFactor = 0.12;
    this.controls.zoomToCursor = true;
    this.root = new Scene();
    this.frame = new Group(); // the scene's frame, turned so that its up axis is three.js's y
    this.floor = new Floor();
    this.gizmo = new Gizmo(gizmoRoot);
    this.root.add(this.frame, this.floor.mesh);
    this.layers = new Map(); // name -> { object, cloud, tintName }
    this.pointFactor = 1;
    this.pending = 0;
    this.pixelShare = 1; // of the screen's pixels along each side
    this.onDraw = () => {};
    this.setUp('z');
    this.controls.addEventListener('change', () => this.invalidate());
    canvas.addEventListener('keydown', (event) => this.key(event));
    new ResizeObserver(() => this.resize()).observe(canvas);
    onThemeChange(() => this.retint());
    this.resize();
  }

  /** Adds or replaces a layer. `cloud` is a Cloud or null, `object` anything three.js draws. */
  setLayer(name, { object, cloud = null, tint }) {
    const old = this.layers.get(name);
    if (old) this.frame.remove(old.object);
    this.layers.set(name, { object, cloud, tint });
    if (old) object.visible = old.object.visible;
    this.frame.add(object);
    this.retint();
    this.resizePoints();
  }

  removeLayer(name) {
    const layer = this.layers.get(name);
    if (layer) this.frame.remove(layer.object);
    this.layers.delete(name);
    this.invalidate();
  }

  layer(name) {
    return this.layers.get(name) ?? null;
  }

  setVisible(name, visible) {
    const layer = this.layers.get(name);
    if (layer) layer.object.visible = visible;
    this.invalidate();
  }

  setPointFactor(factor) {
    this.pointFactor = factor;
    this.resizePoints();
  }

  /** Which axis of the scene points up: x, y, z or one of them with a minus. */
  setUp(axis) {
    this.frame.quaternion.setFromUnitVectors(new Vector3(...UP[axis]), new Vector3(0, 1, 0));
    this.frame.updateMatrixWorld(true);
    this.settleFloor();
    this.invalidate();
  }

  /** Looks at the named layers from the side that is most open; elevation: radians above the horizon. */
  look(names, elevation = undefined) {
    const box = this.boundsOf(names);
    if (box.isEmpty()) return;
    this.looking = names;
    const sphere = box.getBoundingSphere(new Sphere());
    const scene = this.layers.get('scene');
    const positions = (scene?.cloud?.samples ?? scene?.cloud?.geometry)?.getAttribute('position') ?? { count: 0 };
    frameSphere(this.camera, this.controls, sphere, clearestDirection(sphere, positions, this.frame.matrixWorld, elevation));
    this.settleFloor();
    this.invalidate();
  }

  key(event) {
    if (moveByKey(event, this.camera, this.controls, () => this.look(this.looking ?? [...this.layers.keys()]))) {
      event.preventDefault();
      this.invalidate();
    }
  }

  boundsOf(names) {
    this.root.updateMatrixWorld(true);
    const box = new Box3();
    for (const name of names) {
      const layer = this.layers.get(name);
      if (layer) box.union(new Box3().setFromObject(layer.object));
    }
    return box;
  }

  settleFloor() {
    const box = this.boundsOf([...this.layers.keys()].filter((name) => name !== 'before' && name !== 'context'));
    if (box.isEmpty()) return;
    const sphere = box.getBoundingSphere(new Sphere());
    this.floor.place(box, sphere.radius * 2.2);
  }

  settleClipping() {
    const sphere = this.boundsOf([...this.layers.keys()]).getBoundingSphere(new Sphere());
    const distance = this.camera.position.distanceTo(sphere.center);
    this.camera.far = distance + sphere.radius * 4;
    this.camera.near = Math.max(this.camera.far / 4000, distance - sphere.radius * 4);
    this.camera.updateProjectionMatrix();
  }

  retint() {
    for (const { object, cloud, tint } of this.layers.values()) {
      const color = themeColor(tint);
      if (cloud) cloud.tint(color);
      else object.material.color.copy(color).convertSRGBToLinear();
    }
    this.floor.tint(themeColor('grid'));
    this.invalidate();
  }

  resize() {
    const { clientWidth, clientHeight } = this.renderer.domElement;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2) * this.pixelShare);
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.resizePoints();
  }

  setPixelShare(share) {
    if (share === this.pixelShare) return;
    this.pixelShare = share;
    this.resize();
  }

  resizePoints() {
    const ratio = this.renderer.getPixelRatio();
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    const pixelsPerUnit = (this.renderer.domElement.clientHeight * ratio) / (2 * half);
    for (const { cloud } of this.layers.values()) cloud?.resize(this.pointFactor, pixelsPerUnit, ratio);
    this.invalidate();
  }

  /** Milliseconds that one frame takes to be drawn to its end. */
  timeFrame() {
    const began = performance.now();
    this.renderer.render(this.root, this.camera);
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits for the drawing, which `finish` need not
    return performance.now() - began;
  }

  /** Draws once, with the next frame of the display. */
  invalidate() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      this.controls.update(); // asks for another frame through 'change' while the motion settles
      this.settleClipping();
      this.renderer.render(this.root, this.camera);
      this.onDraw();
      this.gizmo.turn(this.camera, this.frame.getWorldQuaternion(new Quaternion()));
    });
  }
}

function rendererFor(canvas, antialias) {
  const context = canvas.getContext('webgl2', { antialias, alpha: true });
  if (!context) throw new Error('This browser has no WebGL 2. The numbers and the downloads work without it.');
  return new WebGLRenderer({ canvas, context, antialias, alpha: true });
}
