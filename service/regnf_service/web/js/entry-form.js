// The form that makes a field an entry of the library, or changes an entry.

import { told } from './api.js';
import { byId, el, show } from './dom.js';
import { Turns } from './latest.js';
import { progressLine } from './progress.js';
import { fieldOf, nameOf, untilDone } from './uploads.js';

const AXIS = ['entry-x', 'entry-y', 'entry-z'];

export class EntryForm {
  /** onSaved() hears of every change. */
  constructor(service, onSaved) {
    Object.assign(this, { service, onSaved, entry: null, named: false, saving: false, turns: new Turns() });
    byId('entry-form').addEventListener('submit', (event) => this.save(event));
    byId('entry-dialog').addEventListener('cancel', (event) => { if (this.saving) event.preventDefault(); });
    byId('entry-close').addEventListener('click', () => byId('entry-dialog').close());
    byId('entry-symmetry').addEventListener('change', () => this.showTurns());
    byId('entry-name').addEventListener('input', () => { this.named = true; });
    byId('entry-field').addEventListener('change', () => this.suggest(byId('entry-field').selectedOptions[0]?.text));
    byId('entry-file').addEventListener('change', () => this.tookFiles());
  }

  /** A new entry; sha256: of the field that is meant, if one is. */
  async add(sha256 = '') {
    const isLatest = this.turns.next();
    this.fill(null);
    byId('entry-field').replaceChildren(el('option', { value: '' }, 'none'));
    byId('entry-dialog').showModal(); // at once: the list of fields may take its time
    try {
      const fields = (await this.service.all('fields')).filter(({ state, library }) => state === 'ready' && !library);
      if (!isLatest()) return;
      byId('entry-field').append(...fields.map((field) => el('option', { value: field.sha256 }, nameOf(field))));
      byId('entry-field').value = fields.some((field) => field.sha256 === sha256) ? sha256 : '';
      if (byId('entry-field').value) this.suggest(byId('entry-field').selectedOptions[0].text);
    } catch (error) {
      if (isLatest()) this.complain(error);
    }
  }

  /** With several files each has its own name; what else is said is said of all. */
  tookFiles() {
    const { files } = byId('entry-file');
    this.suggest(files[0]?.name);
    for (const id of ['entry-name', 'entry-name-label']) show(byId(id), files.length < 2);
    byId('entry-name').required = files.length < 2;
  }

  change(entry) {
    this.turns.next();
    this.fill(entry);
    byId('entry-dialog').showModal();
  }

  /** A name for the object, unless one was typed. */
  suggest(text) {
    if (this.named || !text) return;
    byId('entry-name').value = entryName(text);
  }

  fill(entry) {
    Object.assign(this, { entry, named: Boolean(entry) });
    byId('entry-form').reset();
    this.tookFiles();
    byId('entry-form').classList.toggle('changing', Boolean(entry));
    byId('entry-title').textContent = entry ? `Change ${entry.name}` : 'Add objects';
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
    if (this.saving) return;
    this.busy(true);
    try {
      const saved = await untilDone(() => (this.entry ? this.patch() : this.addAll([...byId('entry-file').files])));
      if (saved) byId('entry-dialog').close();
      await this.onSaved();
    } catch (error) {
      this.complain(error);
    } finally {
      this.busy(false);
    }
  }

  /** While it is saved the form stays as it is and where it is. */
  busy(saving) {
    this.saving = saving;
    for (const id of ['entry-save', 'entry-close']) byId(id).disabled = saving;
  }

  complain(error) {
    byId('entry-state').replaceChildren(el('p', { className: 'bad' }, told(error)));
  }

  async patch() {
    await this.send('PATCH', `/library/${encodeURIComponent(this.entry.name)}`, this.notes());
    return true;
  }

  /** An entry for each file, or for the field that is chosen. Whether all are there; what failed says why. */
  async addAll(files) {
    const notes = this.notes();
    if (!files.length) {
      if (!byId('entry-field').value) throw new Error('Choose a field or files.');
      await this.send('POST', '/library', { ...notes, field: byId('entry-field').value });
      return true;
    }
    byId('entry-state').replaceChildren();
    const saved = await Promise.all(files.map((file) => this.addFile(file, files.length > 1 ? { ...notes, name: entryName(file.name) } : notes)));
    if (files.length > 1) byId('entry-file').value = ''; // those that were saved need not be sent again
    return saved.every(Boolean);
  }

  async addFile(file, notes) {
    const line = progressLine(file.name);
    byId('entry-state').append(line.node);
    try {
      const { sha256 } = await fieldOf(this.service, file, 'object', line.step);
      await this.send('POST', '/library', { ...notes, field: sha256 });
      line.done();
      return true;
    } catch (error) {
      line.fail(error);
      return false;
    }
  }

  send(method, path, body) {
    return this.service.request(path, { method, headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body) });
  }
}

/** A file's or a field's name as one that an entry may have. */
const entryName = (text) => text.replace(/\.\w{1,12}$/, '').replace(/[/\\?#%]/g, ' ').trim().replace(/^\.+/, '').slice(0, 64).trim();
