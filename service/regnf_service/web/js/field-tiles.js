// One tile a field: its picture, what its import found, and what can be done with it.

import { toldOf } from './api.js';
import { askFirst } from './confirm.js';
import { el } from './dom.js';
import { bytes, moment, words } from './format.js';
import { canvasOf, panelsOf } from './pictures.js';
import { framePicture, framesOf, isRecording } from './recordings.js';
import { sayRole } from './roles.js';
import { nameOf, sizeOf } from './uploads.js';

const TONES = { ready: 'good', rejected: 'bad', validating: 'warn' };

const framesWords = (field) => isRecording(field) && framesOf(field).length > 1 && `${framesOf(field).length} frames`;

export class FieldTiles {
  constructor(service, store, refresh) {
    Object.assign(this, { service, store, refresh, empty: 'No fields yet. Upload them on the page Register.' });
  }

  entries() {
    return [...this.store.recordings, ...this.store.fields].map((field) => ({ text: nameOf(field), states: [field.state], node: this.tile(field) }));
  }

  tile(field) {
    const { report = {}, error } = field;
    const size = isRecording(field) ? '' : sizeOf(report.surface_bounds ?? report.bounds);
    const facts = [size, report.family ?? report.layout, framesWords(field), bytes(field.bytes), moment(field.created_at)].filter(Boolean).join(', ');
    const node = el('article', { className: 'tile' },
      el('h2', { tabIndex: -1 }, nameOf(field)),
      el('span', { className: 'word', 'data-tone': TONES[field.state] }, words(field.state)),
      el('span', { className: 'note' }, error ? toldOf(error) : facts),
      ...(field.state === 'ready' && !isRecording(field) ? [this.roleChoice(field)] : []),
      el('p', { className: 'row' }, ...this.actions(field)));
    if (field.state === 'ready') this.picture(field, node);
    return node;
  }

  /** What the page takes the field for; a person may know better. */
  roleChoice(field) {
    const role = this.store.role(field);
    const options = [['object', 'an object'], ['scene', 'a scene']].map(([value, text]) => el('option', { value, selected: value === role }, text));
    const select = el('select', { 'aria-label': `What ${nameOf(field)} is` }, ...options);
    select.onchange = () => {
      sayRole(field.sha256, select.value);
      this.store.tell();
    };
    return el('label', { className: 'role note', title: 'Your choice is stored only in this browser.' }, 'This is ', select);
  }

  actions(field) {
    const remove = el('button', { type: 'button', className: 'quiet', 'aria-label': `Delete ${nameOf(field)}` }, 'Delete');
    remove.onclick = () => this.remove(field);
    if (field.state !== 'ready') return [remove];
    const toScene = el('a', { className: 'button', href: `${this.service.root}/?scene=${field.sha256}` }, 'Use as scene');
    if (isRecording(field)) return [toScene, remove];
    const use = this.store.role(field) === 'scene' ? ['scene', 'Use as scene'] : ['object', 'Search for this'];
    return [
      el('a', { className: 'button', href: `${this.service.root}/?${use[0]}=${field.sha256}` }, use[1]),
      ...(field.library ? [] : [el('a', { className: 'button', href: `${this.service.root}/library#add=${field.sha256}` }, 'Add to library')]),
      el('a', { className: 'button', href: field.links.mesh, download: `${nameOf(field)}.glb` }, 'Mesh'),
      remove,
    ];
  }

  async picture(field, node) {
    const place = el('p', { className: 'note' }, field.views === 'pending' ? 'The picture is being drawn.' : '');
    node.prepend(place);
    try {
      place.replaceWith(await this.canvas(field));
    } catch {
      place.remove(); // not every field has one
    }
  }

  async canvas(field) {
    if (isRecording(field)) {
      const [first] = framesOf(field);
      return canvasOf(await framePicture(this.service, field.sha256, first), `${nameOf(field)}: its first frame`, null, false);
    }
    const role = this.store.role(field);
    const label = `${nameOf(field)}: ${role === 'scene' ? 'a view and a section' : 'two views'}`;
    return canvasOf(await this.service.picture(field.sha256), label, panelsOf(role));
  }

  async remove(field) {
    const what = `Delete ${nameOf(field)}?`;
    const lost = 'The service deletes it. The file on your own disk is kept. Jobs that used it keep their results.';
    const act = () => this.service.request(`/fields/${field.sha256}`, { method: 'DELETE' });
    if (await askFirst({ what, lost, verb: 'Delete', act })) await this.refresh();
  }
}
