// The objects to look for: those of the service, and files that are added.

import { byId, el, show } from './dom.js';
import { canvasOf, panelsOf } from './pictures.js';
import { progressLine } from './progress.js';
import { sayRole } from './roles.js';
import { fieldOf, nameOf } from './uploads.js';

export class ObjectList {
  /** Draws from store; onChange() hears every change of the choice. */
  constructor(service, store, onChange) {
    Object.assign(this, { service, store, onChange, checked: new Set(), rows: new Map(), scene: null });
    const asked = new URLSearchParams(location.search);
    const [object, tag] = [asked.get('object'), asked.get('tag')];
    this.isAskedFor = ({ sha256, library }) => sha256 === object || (tag !== null && library && (!tag || library.tags.includes(tag)));
    byId('object-file').addEventListener('change', (event) => {
      this.take([...event.target.files]);
      event.target.value = ''; // the same file may be chosen again
    });
    byId('all-objects').addEventListener('change', (event) => {
      for (const field of this.objects()) this.mark(field.sha256, event.target.checked);
      this.changed();
    });
    store.onChange(() => this.changed());
  }

  /** Documents of the fields that are chosen. */
  chosen() {
    return this.offered().filter(({ sha256 }) => this.checked.has(sha256));
  }

  /** The scene is none of the objects. */
  leaveOut(sha256) {
    this.scene = sha256;
    this.changed();
  }

  take(files) {
    return Promise.all(files.map((file) => this.takeOne(file)));
  }

  async takeOne(file) {
    const line = progressLine(file.name);
    byId('object-state').append(line.node);
    try {
      const field = await fieldOf(this.service, file, 'object', line.step);
      sayRole(field.sha256, 'object');
      this.checked.add(field.sha256);
      this.store.put(field);
      line.done();
    } catch (error) {
      line.fail(error);
    }
  }

  mark(sha256, checked) {
    if (checked) this.checked.add(sha256);
    else this.checked.delete(sha256);
  }

  offered() {
    return this.store.ready().filter(({ sha256 }) => sha256 !== this.scene);
  }

  /** What "all of them" means: scenes are no candidates, but may be chosen one by one. */
  objects() {
    return this.offered().filter((field) => this.store.role(field) === 'object');
  }

  /** Draws both lists from what is known now. */
  changed() {
    const offered = this.offered();
    for (const field of offered) if (!this.rows.has(field.sha256)) this.addRow(field);
    const objects = this.objects();
    const scenes = offered.filter((field) => !objects.includes(field));
    this.place(byId('objects'), objects);
    this.place(byId('scenes-as-objects'), scenes);
    for (const [sha256, { box }] of this.rows) box.checked = this.checked.has(sha256);
    show(byId('objects-of-scenes'), scenes.length > 0);
    show(byId('all-row'), objects.length > 1);
    byId('all-objects').checked = objects.length > 0 && objects.every(({ sha256 }) => this.checked.has(sha256));
    this.onChange();
  }

  /** Has the host show the rows of these fields, in this order; rows that stay where they are keep the focus. */
  place(host, fields) {
    const rows = fields.map(({ sha256 }) => this.rows.get(sha256).row);
    const shown = [...host.querySelectorAll('.check')];
    if (rows.length !== shown.length || rows.some((row, i) => row !== shown[i])) {
      shown.forEach((row) => row.remove());
      host.append(...rows);
    }
    for (const field of fields) this.rows.get(field.sha256).name.replaceChildren(nameOf(field), ...tagsOf(field));
  }

  addRow(field) {
    if (this.isAskedFor(field)) this.checked.add(field.sha256);
    const box = el('input', { type: 'checkbox', value: field.sha256, autocomplete: 'off' });
    box.onchange = () => {
      this.mark(field.sha256, box.checked);
      this.changed();
    };
    const name = el('span', {});
    const row = el('label', { className: 'check' }, box, name);
    this.rows.set(field.sha256, { row, box, name });
    this.picture(field, row);
  }

  async picture(field, row) {
    try {
      row.append(await canvasOf(await this.service.picture(field.sha256), '', panelsOf(this.store.role(field))));
    } catch {
      // not every field has one
    }
  }
}

function tagsOf(field) {
  const tags = field.library?.tags ?? [];
  return tags.length ? [el('span', { className: 'note' }, ` ${tags.join(', ')}`)] : [];
}
