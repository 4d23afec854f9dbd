// The objects to look for: those of the service, and files that are added.

import { byId, el, show } from './dom.js';
import { canvasOf } from './pictures.js';
import { progressLine } from './progress.js';
import { fieldOf, nameOf } from './uploads.js';

export class ObjectList {
  /** onChange() hears every change of the choice. */
  constructor(service, onChange) {
    Object.assign(this, { service, onChange, fields: [], boxes: new Map(), scene: null });
    byId('object-file').addEventListener('change', (event) => this.take([...event.target.files]));
    byId('all-objects').addEventListener('change', (event) => {
      for (const box of this.shown()) box.checked = event.target.checked;
      this.onChange();
    });
  }

  async load() {
    const fields = (await this.service.all('fields')).filter(({ state }) => state === 'ready');
    this.fields = [...fields.filter(({ library }) => library), ...fields.filter(({ library }) => !library)]; // the library's first
    const asked = new URLSearchParams(location.search);
    const [object, tag] = [asked.get('object'), asked.get('tag')];
    const meant = ({ sha256, library }) => sha256 === object || (tag !== null && library && (!tag || library.tags.includes(tag)));
    for (const field of this.fields) this.add(field, meant(field));
  }

  /** Documents of the fields that are chosen. */
  chosen() {
    return this.fields.filter(({ sha256 }) => sha256 !== this.scene && this.boxes.get(sha256)?.checked);
  }

  /** The scene is none of the objects. */
  leaveOut(sha256) {
    this.scene = sha256;
    for (const [name, box] of this.boxes) show(box.parentElement, name !== sha256);
    this.showAll();
  }

  take(files) {
    return Promise.all(files.map((file) => this.takeOne(file)));
  }

  async takeOne(file) {
    const line = progressLine(file.name);
    byId('object-state').append(line.node);
    try {
      this.add(await fieldOf(this.service, file, 'object', line.step), true);
      line.done();
    } catch (error) {
      line.fail(error);
    }
  }

  add(field, checked) {
    if (!this.boxes.has(field.sha256)) {
      const box = el('input', { type: 'checkbox', value: field.sha256, onchange: () => this.onChange() });
      const row = el('label', { className: 'check' }, box, el('span', {}, nameOf(field), ...tagsOf(field)));
      byId('objects').append(row);
      this.boxes.set(field.sha256, box);
      if (!this.fields.includes(field)) this.fields.unshift(field);
      this.picture(field, row);
    }
    if (checked) this.boxes.get(field.sha256).checked = true;
    this.showAll();
    this.onChange();
  }

  async picture(field, row) {
    try {
      row.append(await canvasOf(await this.service.picture(field.sha256), ''));
    } catch {
      // not every field has one
    }
  }

  shown() {
    return [...this.boxes].filter(([sha256]) => sha256 !== this.scene).map(([, box]) => box);
  }

  showAll() {
    show(byId('all-row'), this.shown().length > 1);
  }
}

function tagsOf(field) {
  const tags = field.library?.tags ?? [];
  return tags.length ? [el('span', { className: 'note' }, ` ${tags.join(', ')}`)] : [];
}
