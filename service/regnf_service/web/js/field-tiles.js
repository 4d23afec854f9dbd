// One tile a field: its picture, what its import found, and what can be done with it.

import { byId, el } from './dom.js';
import { bytes, moment, number, words } from './format.js';
import { canvasOf } from './pictures.js';
import { nameOf } from './uploads.js';

const TONES = { ready: 'good', rejected: 'bad', validating: 'warn' };

export class FieldTiles {
  constructor(service, refresh) {
    Object.assign(this, { service, refresh, entries: [], empty: 'No fields yet. Upload them on the page Register.' });
  }

  async load() {
    const fields = await this.service.all('fields');
    this.entries = fields.map((field) => ({ text: nameOf(field), states: [field.state], node: this.tile(field) }));
  }

  tile(field) {
    const { report = {}, error } = field;
    const size = report.bounds && report.bounds[1].map((high, i) => number(high - report.bounds[0][i], 3)).join(' × ');
    const facts = [report.family, size, bytes(field.bytes), moment(field.created_at)].filter(Boolean).join(', ');
    const node = el('article', { className: 'tile' },
      el('h2', {}, nameOf(field)),
      el('span', { className: 'word', 'data-tone': TONES[field.state] }, words(field.state)),
      el('span', { className: 'note' }, error ? `${error.detail} ${error.hint ?? ''}` : facts),
      el('p', { className: 'row' }, ...this.actions(field)));
    if (field.state === 'ready') this.picture(field, node);
    return node;
  }

  actions(field) {
    const remove = el('button', { type: 'button', className: 'quiet', 'aria-label': `Delete ${nameOf(field)}` }, 'Delete');
    remove.onclick = () => this.remove(field);
    if (field.state !== 'ready') return [remove];
    return [
      el('a', { className: 'button', href: `${this.service.root}/?scene=${field.sha256}` }, 'Use as scene'),
      ...(field.library ? [] : [el('a', { className: 'button', href: `${this.service.root}/library#add=${field.sha256}` }, 'Add to library')]),
      el('a', { className: 'button', href: field.links.mesh, download: `${nameOf(field)}.glb` }, 'Mesh'),
      remove,
    ];
  }

  async picture(field, node) {
    const place = el('p', { className: 'note' }, field.views === 'pending' ? 'The picture is being drawn.' : '');
    node.prepend(place);
    try {
      place.replaceWith(await canvasOf(await this.service.picture(field.sha256), `${nameOf(field)}: two views and a section`));
    } catch {
      place.remove(); // not every field has one
    }
  }

  async remove(field) {
    try {
      await this.service.request(`/fields/${field.sha256}`, { method: 'DELETE' });
      await this.refresh();
    } catch (error) {
      byId('note').textContent = `${error.message} ${error.problem?.hint ?? ''}`;
    }
  }
}
