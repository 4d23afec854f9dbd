// The 3D view of one result: loads its surfaces, wires the view's own controls, moves the object.

import { Cloud, geometryFromArrays, geometryFromPly, isColorful } from './cloud.js';
import { wireBox } from './box.js';
import { detectionOf, upAxisOf } from './documents.js';
import { byId, el, show } from './dom.js';
import { Turns } from './latest.js';
import { residualHistogram } from './plot.js';
import { readResiduals } from './residuals.js';
import { meshesOf } from './result-meshes.js';
import { between, inverse } from './sim3.js';
import { Viewer } from './viewer.js';

const FOCUS = ['after', 'box'];
const LAYERS = ['scene', 'context', 'before', 'after'];

export class Stage {
  /** names: of the artifacts; fieldNames: the documents of the fields, as names.js has them. */
  constructor(api, names, fieldNames) {
    Object.assign(this, { api, names, fieldNames });
    this.pose = null; // T_scene_object of the moving object
    this.residuals = null;
    this.plain = {}; // name -> Cloud
    this.meshes = null; // name -> Surface
    this.marked = []; // names of layers
    this.turns = new Turns();
  }

  /** Fetches the surfaces and shows them; frames as documents.js reads them. */
  async open(job, result, frames) {
    const [scene, object] = await Promise.all(['scene_points.ply', 'object_points.ply'].map((name) => this.api.artifact(name)));
    this.plain.scene = new Cloud(geometryFromPly(scene), { seeThrough: true });
    this.plain.after = new Cloud(geometryFromPly(object), { nearer: 0.6 });
    show(byId('canvas'));
    this.viewer = new Viewer(byId('canvas'), byId('gizmo'));
    byId('up').value = upAxisOf(result);
    this.viewer.setUp(byId('up').value);
    show(byId('gizmo'));
    this.poses = frames.map((frame) => inverse(frame.pose));
    const box = detectionOf(job, result);
    const fields = { scene: job.inputs?.scene, object: result.object ?? job.inputs?.object };
    await this.readContext();
    const meshes = (detail) => meshesOf(this.api, this.fieldNames, fields, box, this.plain.scene.geometry, detail);
    const areDrawn = !(await this.areToCome(fields));
    if (areDrawn) this.meshes = await meshes('coarse'); // they come at once; the fine ones follow
    if (frames.length > 1) this.plain.before = new Cloud(this.plain.after.geometry, { opacity: 0.35, discs: 0.5 });
    else if (this.meshes) this.meshes.before = null;
    show(byId('before-chip'), frames.length > 1);
    show(byId('surfaces-dial'), this.meshes !== null);
    this.addBox(box);
    this.draw();
    this.moveTo(frames.length - 1);
    this.wire();
    this.viewer.look(FOCUS);
    show(byId('tools'));
    if (this.meshes || !areDrawn) meshes('fine').then((made) => this.takeMeshes(made));
  }

  /** Whether a worker has yet to draw the scene or the object. */
  async areToCome({ scene, object }) {
    const found = await Promise.all([scene, object].map((sha256) => this.fieldNames.document(sha256)));
    return found.some((field) => field?.views === 'pending');
  }

  /** Shows meshes that are finer, or that were drawn after the page was opened; null: there are none. */
  takeMeshes(meshes) {
    if (!meshes) return;
    this.meshes = meshes;
    if (this.poses.length < 2) this.meshes.before = null;
    show(byId('surfaces-dial'));
    this.redraw();
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

  /** Marks what speaks against a pose, as considered.js has it; null: nothing. */
  showMarks(marks) {
    for (const name of this.marked) this.viewer.removeLayer(name);
    this.marked = [];
    const cloudOf = (points) => new Cloud(geometryFromArrays(points, new Float32Array(points.length / 3)), { nearer: 1.5, discs: 0.6 });
    for (const { name, positions, all, tint, pose } of marks ?? []) {
      if (positions.length === 0) continue;
      const cloud = cloudOf(positions);
      cloud.spacing = cloudOf(all).spacing; // discs as large as if all were drawn
      cloud.colorBy('layer');
      if (pose) cloud.place(pose);
      this.viewer.setLayer(`marks-${name}`, { object: cloud.points, cloud, tint });
      this.marked.push(`marks-${name}`);
    }
    this.viewer.invalidate();
  }

  /** T_scene_object: where the object stands in the scene. */
  place(pose) {
    this.pose = pose;
    this.viewer?.layer('after').cloud.place(pose);
    this.viewer?.invalidate();
  }

  /** The scene round the detection; older results have none, and the view does without it. */
  async readContext() {
    if (!this.names.includes('context_points.ply')) return;
    const geometry = geometryFromPly(await this.api.artifact('context_points.ply'));
    this.plain.context = new Cloud(geometry, { seeThrough: true, discs: 0.35 });
  }

  /** Shows the surfaces as they are chosen: meshes or samples, in their colors; residuals, if given, are of samples. */
  draw(residuals = null) {
    const asMeshes = this.meshes !== null && byId('surfaces').value === 'meshes';
    const chosen = { ...(asMeshes ? this.meshes : this.plain) };
    for (const cloud of Object.values(chosen)) cloud?.colorBy(byId('color').value === 'file' ? 'file' : 'layer');
    if (residuals?.scene) chosen.scene = residuals.scene;
    if (residuals?.object) chosen.after = residuals.object;
    chosen.before?.place(this.poses[0]);
    for (const name of LAYERS) this.setLayer(name, chosen[name]);
    show(byId('context-chip'), Boolean(chosen.context));
    show(byId('size-dial'), !asMeshes || residuals !== null);
  }

  setLayer(name, cloud) {
    if (!cloud) return this.viewer.removeLayer(name);
    this.viewer.setLayer(name, { object: cloud.points, cloud, tint: `cloud-${name}` });
    return this.viewer.setVisible(name, byId('layers').querySelector(`input[data-layer="${name}"]`).checked);
  }

  addBox(box) {
    show(byId('box-chip'), Boolean(box));
    if (box) this.viewer.setLayer('box', { object: wireBox(box), tint: 'cloud-box' });
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
    byId('color').onchange = () => this.redraw();
    byId('surfaces').onchange = () => this.redraw();
    this.offer('residual', this.names.includes('residuals.npz'));
    const drawn = [this.plain.scene, this.plain.after, this.meshes?.scene, this.meshes?.after].filter(Boolean);
    this.offer('file', drawn.some((cloud) => isColorful(cloud.geometry)));
  }

  offer(value, available) {
    const option = byId('color').querySelector(`option[value="${value}"]`);
    option.hidden = !available;
    option.disabled = !available;
  }

  async redraw() {
    const isLatest = this.turns.next();
    const residuals = byId('color').value === 'residual' ? await this.loadResiduals() : null;
    if (!isLatest()) return;
    this.draw(residuals);
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
  byId('legend-note').textContent = areOfThePoseShown ? '' : ' – for the result’s pose, not for the displayed one';
}
