// Which scene: a file that is chosen or dropped, a frame or a recording, one of the service, or the demo. The latest choice
// counts.

import { told } from './api.js';
import { byId, el, show } from './dom.js';
import { filesOf } from './dropped.js';
import { sorted } from './frame-files.js';
import { FrameForm } from './frame-form.js';
import { Turns } from './latest.js';
import { progressLine } from './progress.js';
import { isRecording, recordingOfFile, recordingOfFrame } from './recordings.js';
import { sayRole } from './roles.js';
import { fieldOf, nameOf } from './uploads.js';

export class SceneChoice {
  /**
   * Draws from store; onScene(field, up, isLatest) shows a scene, a field or a recording; onMask(file) marks a thing in
   * the picture that is shown. objects takes the files that are dropped beside a scene.
   */
  constructor(service, store, { onScene, onMask }, objects) {
    Object.assign(this, { service, store, onScene, onMask, objects, field: null, turns: new Turns() });
    this.frame = new FrameForm((parts) => this.takeFrame(parts));
    byId('scene-file').addEventListener('change', (event) => {
      this.takeFiles([...event.target.files]);
      event.target.value = ''; // the same file may be chosen again
    });
    byId('scene-known').addEventListener('change', (event) => this.takeKnown(event.target.value));
    byId('demo').addEventListener('click', () => this.takeDemo());
    store.onChange(() => this.draw());
    this.listen(byId('stage'));
  }

  /** Opens the scene that the address names, and offers the demo where there is one. */
  async load() {
    const asked = new URLSearchParams(location.search).get('scene');
    await Promise.all([this.offerDemo(), asked && this.takeKnown(asked)]);
  }

  async offerDemo() {
    this.demo = await this.service.json('/demo').catch(() => null);
    show(byId('demo'), Boolean(this.demo));
  }

  /** The list of scenes: a drawing of what the store knows. */
  draw() {
    const ready = this.store.ready();
    const optionOf = (field) => el('option', { value: field.sha256 }, nameOf(field));
    const group = (label, role) => {
      const options = ready.filter((field) => this.store.role(field) === role).map(optionOf);
      return options.length ? [el('optgroup', { label }, ...options)] : [];
    };
    const recordings = this.store.recordings.filter(({ state }) => state === 'ready').map(optionOf);
    const recorded = recordings.length ? [el('optgroup', { label: 'Recordings' }, ...recordings)] : [];
    byId('scene-known').replaceChildren(el('option', { value: '' }, 'none'), ...recorded, ...group('Scenes', 'scene'), ...group('Objects', 'object'));
    byId('scene-known').value = this.field?.sha256 ?? '';
  }

  listen(stage) {
    for (const kind of ['dragover', 'dragleave', 'drop']) {
      document.addEventListener(kind, (event) => {
        event.preventDefault();
        stage.classList.toggle('over', kind === 'dragover');
        if (kind !== 'drop') return;
        const onObjects = event.target.closest?.('[aria-labelledby="objects-title"]');
        const files = filesOf(event.dataTransfer);
        if (onObjects) files.then((found) => this.objects.take(found));
        else files.then((found) => this.takeFiles(found));
      });
    }
  }

  /**
   * A recording or the parts of a frame are the scene, and the rest are objects. Else, without a scene the largest file
   * becomes it, the others are objects; with one, several are objects all.
   */
  async takeFiles(files) {
    if (!files.length) return;
    const isLatest = this.turns.next();
    const found = await sorted(files);
    if (found.recording || this.frame.isPart(found)) {
      this.objects.take(found.rest);
      if (isLatest()) await this.takePictures(found, isLatest);
      return;
    }
    const [largest, ...rest] = [...found.rest, ...(found.settings ? [found.settings] : [])].sort((a, b) => b.size - a.size);
    this.objects.take(rest);
    if (largest && isLatest()) await this.takeField(largest, isLatest);
    if (!largest) this.fail(new Error(`${files[0].name} is neither a scene nor a part of a frame.`));
  }

  async takePictures(found, isLatest) {
    const { recording, mask, depth, color, camera } = found;
    if (recording) {
      await this.take(recording.name, (onStep) => recordingOfFile(this.service, recording, onStep), isLatest);
    } else if (mask && !depth && !color && !camera && this.field && isRecording(this.field)) {
      await this.onMask(mask).catch((error) => this.fail(error)); // of the picture that is shown
    } else {
      await this.frame.take(found);
    }
  }

  takeField(file, isLatest) {
    return this.take(file.name, async (onStep) => {
      const field = await fieldOf(this.service, file, 'scene', onStep);
      sayRole(field.sha256, 'scene');
      return field;
    }, isLatest);
  }

  async takeFrame(parts) {
    const isLatest = this.turns.next();
    await this.take(parts.depth.name, (onStep) => recordingOfFrame(this.service, parts, onStep), isLatest, parts.mask);
  }

  /** find(onStep): the document of what is called `name`, as soon as it is ready. */
  async take(name, find, isLatest, mask = null) {
    const lines = [byId('scene-state'), byId('welcome-state')].map((host) => {
      const line = progressLine(name);
      host.replaceChildren(line.node);
      return line;
    });
    byId('welcome').classList.add('busy');
    try {
      const field = await find((...news) => lines.forEach((line) => line.step(...news)));
      this.store.put(field);
      if (isLatest()) await this.use(field, isLatest, mask);
    } catch (error) {
      if (isLatest()) lines.forEach((line) => line.fail(error));
    }
    if (isLatest()) byId('welcome').classList.remove('busy');
  }

  async takeKnown(sha256) {
    const isLatest = this.turns.next();
    if (!sha256) return this.draw(); // there is no way back to no scene
    try {
      const field = await this.service.imported(sha256);
      if (isLatest() && field?.state === 'ready') await this.use(field, isLatest);
      else if (isLatest()) this.fail(new Error('The service has no ready field with this digest. It may have been deleted.'));
    } catch (error) {
      if (isLatest()) this.fail(error);
    }
  }

  async takeDemo() {
    const isLatest = this.turns.next();
    byId('demo').disabled = true;
    try {
      const { scene, object } = this.demo;
      const [room, chair] = await Promise.all([scene, object].map((file) => this.fetched(file)));
      this.objects.take([chair]);
      if (isLatest()) await this.takeField(room, isLatest);
    } catch (error) {
      this.fail(error);
    }
    byId('demo').disabled = false;
  }

  async fetched({ name, address }) {
    const response = await this.service.request(address.slice(this.service.root.length));
    return new File([await response.blob()], name);
  }

  async use(field, isLatest, mask = null) {
    this.field = field;
    this.frame.done();
    for (const id of ['scene-up', 'scene-up-label']) show(byId(id), !isRecording(field));
    const up = field.description?.up_axis ?? 'z';
    byId('scene-up').value = up;
    const { notes = [], warnings = [] } = isRecording(field) ? field.report : {};
    byId('scene-state').replaceChildren(el('strong', {}, nameOf(field)),
      ...warnings.map((text) => el('p', { className: 'warn' }, text)), ...notes.map((text) => el('p', { className: 'note' }, text)));
    this.draw();
    try {
      await this.onScene(field, up, isLatest);
      if (mask && isLatest()) await this.onMask(mask);
    } catch (error) {
      if (isLatest()) this.fail(error);
    }
  }

  fail(error) {
    byId('scene-state').append(el('p', { className: 'bad' }, told(error)));
    this.draw();
  }
}
