// The 3D view of one result: loads its clouds, wires the view's own controls, moves the object.

import { Cloud, geometryFromPly, isColorful } from './cloud.js';
import { wireBox } from './box.js';
import { detectionOf, upAxisOf } from './documents.js';
import { byId, el, show } from './dom.js';
import { residualHistogram } from './plot.js';
import { readResiduals } from './residuals.js';
import { between, inverse } from './sim3.js';
import { Viewer } from './viewer.js';

const FOCUS = ['after', 'box'];

export class Stage {
  constructor(api, names) {
    this.api = api;
    this.names = names;
    this.pose = null; // T_scene_object of the moving object
    this.residuals = null;
    this.plain = {};
  }

  /** Fetches the clouds and shows them; frames as documents.js reads them. */
  async open(job, result, frames) {
    const [scene, object] = await Promise.all(['scene_points.ply', 'object_points.ply'].map((name) => this.api.artifact(name)));
    this.plain.scene = new Cloud(geometryFromPly(scene), { seeThrough: true });
    this.plain.after = new Cloud(geometryFromPly(object), { nearer: 0.6 });
    show(byId('canvas'));
    this.viewer = new Viewer(byId('canvas'), byId('gizmo'));
    byId('up').value = upAxisOf(result.options);
    this.viewer.setUp(byId('up').value);
    show(byId('gizmo'));
    this.poses = frames.map((frame) => inverse(frame.pose));
    this.addCloud('scene', this.plain.scene, 'cloud-scene');
    this.addCloud('after', this.plain.after, 'cloud-after');
    await this.addContext();
    this.addBefore(frames.length > 1);
    this.addBox(detectionOf(job, result));
    this.moveTo(frames.length - 1);
    this.wire();
    this.viewer.look(FOCUS);
    show(byId('tools'));
  }

  /** Shows the object at a position along the frames, fractions included. */
  moveTo(position) {
    const low = Math.min(Math.floor(position), this.poses.length - 1);
    const high = Math.min(low + 1, this.poses.length - 1);
    noteResiduals(position >= this.poses.length - 1);
    this.place(position > low ? between(this.poses[low], this.poses[high], position - low) : this.poses[low]);
  }

  /** Shows the object in another pose (T_scene_object) than the result's or one on the way to it. */
  placeAlternative(pose) {
    noteResiduals(false);
    this.place(pose);
  }

  /** T_scene_object: where the object stands in the scene. */
  place(pose) {
    this.pose = pose;
    this.viewer?.layer('after').cloud.place(pose);
    this.viewer?.invalidate();
  }

  addBefore(known) {
    show(byId('before-chip'), known);
    if (!known) return;
    const before = new Cloud(this.plain.after.geometry, { opacity: 0.35, discs: 0.5 });
    before.place(this.poses[0]);
    this.addCloud('before', before, 'cloud-before');
  }

  /** The scene round the detection; older results have none, and the view does without it. */
  async addContext() {
    const known = this.names.includes('context_points.ply');
    show(byId('context-chip'), known);
    if (!known) return;
    const geometry = geometryFromPly(await this.api.artifact('context_points.ply'));
    this.addCloud('context', new Cloud(geometry, { seeThrough: true, discs: 0.35 }), 'cloud-context');
  }

  addBox(box) {
    show(byId('box-chip'), Boolean(box));
    if (box) this.viewer.setLayer('box', { object: wireBox(box), tint: 'cloud-box' });
  }

  addCloud(name, cloud, tint) {
    this.viewer.setLayer(name, { object: cloud.points, cloud, tint });
  }

  wire() {
    for (const input of byId('layers').querySelectorAll('input')) {
      input.onchange = () => this.viewer.setVisible(input.dataset.layer, input.checked);
    }
    byId('up').onchange = (event) => {
      this.viewer.setUp(event.target.value);
      this.viewer.look(this.viewer.looking);
    };
    byId('size').oninput = (event) => this.viewer.setPointFactor(Number(event.target.value));
    byId('frame-object').onclick = () => this.viewer.look(FOCUS);
    byId('frame-all').onclick = () => this.viewer.look([...FOCUS, 'before', 'scene', 'context']);
    byId('color').onchange = (event) => this.colorBy(event.target.value);
    this.offer('residual', this.names.includes('residuals.npz'));
    this.offer('file', Object.values(this.plain).some((cloud) => isColorful(cloud.geometry)));
  }

  offer(value, available) {
    const option = byId('color').querySelector(`option[value="${value}"]`);
    option.hidden = !available;
    option.disabled = !available;
  }

  async colorBy(mode) {
    const residuals = mode === 'residual' ? await this.loadResiduals() : null;
    if (mode === 'residual' && !residuals) return;
    const clouds = residuals ? { scene: residuals.scene, after: residuals.object } : this.plain;
    for (const [name, cloud] of Object.entries(clouds)) {
      if (!cloud) continue;
      if (!residuals) cloud.colorBy(mode);
      this.addCloud(name, cloud, `cloud-${name}`);
    }
    this.place(this.pose);
    show(byId('legend'), Boolean(residuals));
  }

  async loadResiduals() {
    if (this.residuals) return this.residuals;
    try {
      this.residuals = await readResiduals(await this.api.artifact('residuals.npz'), this.plain);
      byId('legend-plot').replaceChildren(residualHistogram(this.residuals.sizes, this.residuals.top));
      return this.residuals;
    } catch (error) {
      this.offer('residual', false);
      byId('color').value = 'layer';
      byId('color').after(el('span', { className: 'note', role: 'status' }, `No residuals: ${error.message}`));
      return null;
    }
  }
}

// The residuals are the result's, wherever the object is shown: nothing is computed in the browser.
function noteResiduals(areOfThePoseShown) {
  byId('legend-note').textContent = areOfThePoseShown ? '' : ' – of the result’s pose, not of the one shown';
}
