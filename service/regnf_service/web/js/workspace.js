// The 3D view of the home page: the scene's mesh, boxes in it, and the objects that were found.

import { Matrix4 } from '../vendor/three.bundle.min.js';
import { wireBox } from './box.js';
import { geometryFromGlb } from './glb.js';
import { Handles, quaternionOf } from './handles.js';
import { Turns } from './latest.js';
import { Mover } from './mover.js';
import { firstHit, rayAt } from './pick.js';
import { Proposer } from './propose.js';
import { Surface, isOriented } from './surface.js';
import { Viewer } from './viewer.js';

const CLICK_PIXELS = 6;

export class Workspace {
  /** onClick(point) hears where the scene was clicked, onBox(box) each change by a handle. */
  constructor(canvas, gizmo, host, { onClick, onBox }) {
    this.viewer = new Viewer(canvas, gizmo, { antialias: false });
    this.handles = new Handles(host, this.viewer, onBox);
    this.mover = new Mover(this.viewer);
    this.up = 'z';
    this.turns = new Turns();
    this.proposer = null;
    this.onClick = onClick;
    this.listen(canvas);
  }

  /** Shows the scene: its coarse mesh first, which arrives at once, then the fine one. */
  async showScene(service, sha256, up) {
    const isLatest = this.turns.next();
    this.clear();
    this.up = up;
    this.viewer.setUp(up);
    const coarse = geometryFromGlb(await service.mesh(sha256, 'coarse'));
    if (!isLatest()) return;
    this.scene = new Surface(coarse, { open: isOriented(coarse) });
    this.viewer.setLayer('scene', { object: this.scene.points, cloud: this.scene, tint: 'mesh-scene' });
    this.viewer.look(['scene'], 0.9);
    this.mover.show(this.scene, coarse, coarse);
    const fine = geometryFromGlb(await service.mesh(sha256, 'fine'));
    if (!isLatest()) return;
    this.mover.show(this.scene, fine, coarse);
    this.proposer = null;
  }

  /** Which axis points up. */
  setUp(up) {
    this.up = up;
    this.proposer = null;
    this.viewer.setUp(up);
    this.viewer.look(['scene'], 0.9);
  }

  clear() {
    for (const name of [...this.viewer.layers.keys()]) this.viewer.removeLayer(name);
    this.handles.edit(null, this.up);
    this.scene = null; // what is not drawn cannot be clicked
    this.proposer = null;
  }

  /** Boxes around what is at a point of the scene, the likeliest first. */
  propose(point) {
    this.proposer ??= new Proposer(this.mover.fine, this.up);
    return this.proposer.around(point);
  }

  /** Draws a box; the one that is edited gets the handles. */
  showBox(id, box, edited) {
    const object = wireBox({ ...box, quaternion: quaternionOf(box, this.up) });
    this.viewer.setLayer(`box-${id}`, { object, tint: edited ? 'cloud-box' : 'box-other' });
    if (edited && this.handles.box !== box) this.handles.edit(box, this.up);
    this.viewer.invalidate();
  }

  removeBox(id) {
    this.viewer.removeLayer(`box-${id}`);
    this.viewer.removeLayer(`found-${id}`);
  }

  /** Shows the object that was found for a box, at T_scene_object; isLatest(): whether it is still wanted by then. */
  async showFound(service, id, sha256, rows, isLatest) {
    const surface = new Surface(geometryFromGlb(await service.mesh(sha256, 'coarse')), { plain: true, nearer: true });
    if (!isLatest()) return;
    surface.place(new Matrix4().set(...rows.flat()));
    this.viewer.setLayer(`found-${id}`, { object: surface.points, cloud: surface, tint: 'cloud-after' });
    this.viewer.invalidate();
  }

  detectionOf(box) {
    return { center: box.center, size: box.size, rotation_quaternion_xyzw: quaternionOf(box, this.up) };
  }

  listen(canvas) {
    let began = null;
    canvas.addEventListener('pointerdown', (event) => { began = event.isPrimary ? event : null; });
    canvas.addEventListener('pointerup', (event) => {
      if (!began) return;
      const moved = Math.hypot(event.clientX - began.clientX, event.clientY - began.clientY);
      began = null;
      if (moved > CLICK_PIXELS || event.button !== 0) return;
      const point = this.hit(event);
      if (point) this.onClick(point);
    });
  }

  /** Where the pointer meets what is drawn of the scene: surfaces seen from behind are not. */
  hit(event) {
    if (!this.scene) return null;
    const { uOpen } = this.scene.material.uniforms;
    return firstHit(this.mover.fine, rayAt(event, this.viewer), (volume) => uOpen.value && volume < 0);
  }
}
