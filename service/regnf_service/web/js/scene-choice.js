// Which scene: a file that is chosen or dropped, a field of the service, or the demo. The latest choice counts.

import { told } from './api.js';
import { byId, el, show } from './dom.js';
import { Turns } from './latest.js';
import { progressLine } from './progress.js';
import { sayRole } from './roles.js';
import { fieldOf, nameOf } from './uploads.js';

export class SceneChoice {
  /** Draws from store; onScene(field, up, isLatest) shows a scene; objects takes the files that are dropped beside one. */
  constructor(service, store, onScene, objects) {
    Object.assign(this, { service, store, onScene, objects, field: null, turns: new Turns() });
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
    byId('scene-known').replaceChildren(el('option', { value: '' }, 'none'), ...group('Scenes', 'scene'), ...group('Objects', 'object'));
    byId('scene-known').value = this.field?.sha256 ?? '';
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
    await this.take(largest, this.turns.next());
  }

  async take(file, isLatest) {
    const lines = [byId('scene-state'), byId('welcome-state')].map((host) => {
      const line = progressLine(file.name);
      host.replaceChildren(line.node);
      return line;
    });
    byId('welcome').classList.add('busy');
    try {
      const field = await fieldOf(this.service, file, 'scene', (...news) => lines.forEach((line) => line.step(...news)));
      sayRole(field.sha256, 'scene');
      this.store.put(field);
      if (isLatest()) await this.use(field, isLatest);
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
      if (isLatest()) await this.take(room, isLatest);
    } catch (error) {
      this.fail(error);
    }
    byId('demo').disabled = false;
  }

  async fetched({ name, address }) {
    const response = await this.service.request(address.slice(this.service.root.length));
    return new File([await response.blob()], name);
  }

  async use(field, isLatest) {
    this.field = field;
    const up = field.description?.up_axis ?? 'z';
    byId('scene-up').value = up;
    byId('scene-state').replaceChildren(el('strong', {}, nameOf(field)));
    this.draw();
    try {
      await this.onScene(field, up, isLatest);
    } catch (error) {
      if (isLatest()) this.fail(error);
    }
  }

  fail(error) {
    byId('scene-state').append(el('p', { className: 'bad' }, told(error)));
    this.draw();
  }
}
