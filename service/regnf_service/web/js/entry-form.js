// The form that makes a field an entry of the library, or changes an entry.

import { byId, el, show } from './dom.js';
import { progressLine } from './progress.js';
import { fieldOf, nameOf } from './uploads.js';

const AXIS = ['entry-x', 'entry-y', 'entry-z'];

export class EntryForm {
  /** onSaved() hears of every change. */
  constructor(service, onSaved) {
    Object.assign(this, { service, onSaved, entry: null, named: false });
    byId('entry-form').addEventListener('submit', (event) => this.save(event));
    byId('entry-close').addEventListener('click', () => byId('entry-dialog').close());
    byId('entry-symmetry').addEventListener('change', () => this.showTurns());
    byId('entry-name').addEventListener('input', () => { this.named = true; });
    byId('entry-field').addEventListener('change', () => this.suggest(byId('entry-field').selectedOptions[0]?.text));
    byId('entry-file').addEventListener('change', () => this.suggest(byId('entry-file').files[0]?.name));
  }

  /** A new entry; sha256: of the field that is meant, if one is. */
  async add(sha256 = '') {
    this.fill(null);
    const fields = (await this.service.all('fields')).filter(({ state, library }) => state === 'ready' && !library);
    const options = fields.map((field) => el('option', { value: field.sha256 }, nameOf(field)));
    byId('entry-field').replaceChildren(el('option', { value: '' }, 'none'), ...options);
    byId('entry-field').value = fields.some((field) => field.sha256 === sha256) ? sha256 : '';
    if (byId('entry-field').value) this.suggest(byId('entry-field').selectedOptions[0].text);
    byId('entry-dialog').showModal();
  }

  change(entry) {
    this.fill(entry);
    byId('entry-dialog').showModal();
  }

  /** A name for the object, unless one was typed. */
  suggest(text) {
    if (this.named || !text) return;
    byId('entry-name').value = text.replace(/\.\w{1,12}$/, '').replace(/[/\\?#%]/g, ' ').trim().replace(/^\.+/, '').slice(0, 64).trim();
  }

  fill(entry) {
    Object.assign(this, { entry, named: Boolean(entry) });
    byId('entry-form').reset();
    byId('entry-form').classList.toggle('changing', Boolean(entry));
    byId('entry-title').textContent = entry ? `Change ${entry.name}` : 'Add an object';
    byId('entry-state').replaceChildren();
    const { name = '', tags = [], unit, note, symmetry, symmetry_source: source } = entry ?? {};
    byId('entry-name').value = name;
    byId('entry-tags').value = tags.join(', ');
    byId('entry-unit').value = unit ?? '';
    byId('entry-note').value = note ?? '';
    const said = source === 'said' ? symmetry : null;
    byId('entry-symmetry').value = !said ? 'detected' : said.continuous ? 'every' : said.order > 1 ? 'turns' : 'none';
    byId('entry-order').value = symmetry?.order ?? 2;
    (symmetry?.axis ?? [0, 0, 1]).forEach((part, i) => { byId(AXIS[i]).value = part; });
    this.showTurns();
  }

  showTurns() {
    const kind = byId('entry-symmetry').value;
    show(byId('entry-turns'), kind === 'turns' || kind === 'every');
    byId('entry-order-label').textContent = kind === 'every' ? 'Ends alike' : 'Turns';
    byId('entry-order').max = kind === 'every' ? 2 : 1000;
    if (kind === 'every' && byId('entry-order').valueAsNumber > 2) byId('entry-order').value = 1;
  }

  notes() {
    const tags = byId('entry-tags').value.split(',').map((tag) => tag.trim()).filter(Boolean);
    return {
      name: byId('entry-name').value.trim(), tags, unit: byId('entry-unit').value || null,
      note: byId('entry-note').value.trim() || null, symmetry: this.symmetry(),
    };
  }

  symmetry() {
    const kind = byId('entry-symmetry').value;
    if (kind === 'detected') return null;
    if (kind === 'none') return { order: 1, axis: null, continuous: false };
    return { order: byId('entry-order').valueAsNumber, axis: AXIS.map((id) => byId(id).valueAsNumber), continuous: kind === 'every' };
  }

  async save(event) {
    event.preventDefault();
    byId('entry-save').disabled = true;
    try {
      if (this.entry) await this.send('PATCH', `/library/${encodeURIComponent(this.entry.name)}`, this.notes());
      else await this.send('POST', '/library', { ...this.notes(), field: await this.field() });
      byId('entry-dialog').close();
      await this.onSaved();
    } catch (error) {
      const where = error.problem?.errors?.[0]?.detail ?? '';
      byId('entry-state').replaceChildren(el('p', { className: 'bad' }, `${error.message} ${where} ${error.problem?.hint ?? ''}`));
    } finally {
      byId('entry-save').disabled = false;
    }
  }

  send(method, path, body) {
    return this.service.request(path, { method, headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body) });
  }

  /** SHA-256 of the field: of the file, once its import has ended, or of the one that is chosen. */
  async field() {
    const [file] = byId('entry-file').files;
    if (!file) {
      if (!byId('entry-field').value) throw new Error('Choose a field or a file.');
      return byId('entry-field').value;
    }
    const line = progressLine(file.name);
    byId('entry-state').replaceChildren(line.node);
    return (await fieldOf(this.service, file, 'object', line.step)).sha256;
  }
}
