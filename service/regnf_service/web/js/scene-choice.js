// Which scene: a file that is chosen or dropped, a field of the service, or the demo.

import { byId, el, show } from './dom.js';
import { progressLine } from './progress.js';
import { fieldOf, nameOf } from './uploads.js';

export class SceneChoice {
  /** onScene(field, up) shows a scene; objects takes the files that are dropped beside one. */
  constructor(service, onScene, objects) {
    Object.assign(this, { service, onScene, objects, field: null });
    byId('scene-file').addEventListener('change', (event) => this.takeFiles([...event.target.files]));
    byId('scene-known').addEventListener('change', (event) => this.takeKnown(event.target.value));
    byId('demo').addEventListener('click', () => this.takeDemo());
    this.listen(byId('stage'));
  }

  /** Fills the list of scenes, opens the one that the address names, and offers the demo where there is one. */
  async load() {
    this.demo = await this.service.json('/demo').catch(() => null);
    show(byId('demo'), Boolean(this.demo));
    for (const field of this.objects.fields) this.list(field);
    const asked = new URLSearchParams(location.search).get('scene');
    if (asked) await this.takeKnown(asked);
  }

  listen(stage) {
    for (const kind of ['dragover', 'dragleave', 'drop']) {
      document.addEventListener(kind, (event) => {
        event.preventDefault();
        stage.classList.toggle('over', kind === 'dragover');
        if (kind !== 'drop') return;
        const onObjects = event.target.closest?.('[aria-labelledby="objects-title"]');
        const files = [...event.dataTransfer.files];
        if (onObjects) this.objects.take(files);
        else this.takeFiles(files);
      });
    }
  }

  /** Without a scene the largest file becomes it, the others are objects; with one, several are objects all. */
  async takeFiles(files) {
    if (!files.length) return;
    const [largest, ...rest] = [...files].sort((a, b) => b.size - a.size);
    this.objects.take(rest);
    await this.take(largest);
  }

  async take(file) {
    const line = progressLine(file.name);
    byId('scene-state').replaceChildren(line.node);
    try {
      const field = await fieldOf(this.service, file, 'scene', line.step);
      this.list(field);
      await this.use(field);
    } catch (error) {
      line.fail(error);
    }
  }

  async takeKnown(sha256) {
    if (!sha256) return;
    try {
      const field = await this.service.imported(sha256);
      if (field?.state === 'ready') await this.use(field);
    } catch (error) {
      this.fail(error);
    }
  }

  async takeDemo() {
    byId('demo').disabled = true;
    const { scene, object } = this.demo;
    const [room, chair] = await Promise.all([scene, object].map((file) => this.fetched(file)));
    this.objects.take([chair]);
    await this.take(room);
  }

  async fetched({ name, address }) {
    const response = await this.service.request(address.slice(this.service.root.length));
    return new File([await response.blob()], name);
  }

  async use(field) {
    this.field = field;
    const up = field.description?.up_axis ?? 'z';
    byId('scene-up').value = up;
    byId('scene-known').value = field.sha256;
    byId('scene-state').replaceChildren(el('strong', {}, nameOf(field)));
    try {
      await this.onScene(field, up);
    } catch (error) {
      this.fail(error);
    }
  }

  fail(error) {
    const hint = error.problem?.hint ?? '';
    byId('scene-state').append(el('p', { className: 'bad' }, `${error.message} ${hint}`));
  }

  list(field) {
    const known = [...byId('scene-known').options].some(({ value }) => value === field.sha256);
    if (!known) byId('scene-known').append(el('option', { value: field.sha256 }, nameOf(field)));
  }
}
