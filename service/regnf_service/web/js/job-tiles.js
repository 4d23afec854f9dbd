// One tile a job: whose objects and scene, its verdict, and what can be done with it.

import { compareJobs } from './compare.js';
import { byId, el } from './dom.js';
import { isActive } from './documents.js';
import { moment, seconds, words } from './format.js';
import { canvasOf } from './pictures.js';
import { runAgain } from './run-again.js';
import { nameOf } from './uploads.js';

const TONES = {
  registered: 'good', ambiguous: 'warn', rejected: 'bad', failed: 'bad', accepted: 'warn', running: 'warn', successful: 'good',
};

export class JobTiles {
  constructor(service, refresh) {
    Object.assign(this, { service, refresh, entries: [], chosen: new Map(), names: new Map() });
    this.empty = 'No jobs yet. Start one on the page Register.';
    byId('compare').addEventListener('click', () => compareJobs(service, [...this.chosen.values()], this));
  }

  async load() {
    const [jobs, fields] = await Promise.all([this.service.all('jobs'), this.service.all('fields')]);
    this.names = new Map(fields.map((field) => [field.sha256, nameOf(field)]));
    this.chosen.clear();
    this.mark();
    this.entries = jobs.map((job) => ({ text: this.nameOf(job), states: [job.status, job.verdict], node: this.tile(job) }));
  }

  /** The chair in the room. */
  nameOf(job) {
    const { scene, object, candidates } = job.inputs;
    const of = (sha256) => this.names.get(sha256) ?? String(sha256).slice(0, 8);
    if (job.kind === 'render') return `Rendering of ${of(scene)}`;
    return `${object ? of(object) : `One of ${candidates} objects`} in ${of(scene)}`;
  }

  tile(job) {
    const word = job.verdict ?? job.status;
    const took = job.finished_at ? seconds((Date.parse(job.finished_at) - Date.parse(job.created_at)) / 1000) : null;
    const facts = [moment(job.created_at), took && `${took} from request to end`, `seed ${job.inputs.seed ?? 0}`].filter(Boolean).join(', ');
    const node = el('article', { className: 'tile' },
      el('h2', {}, this.nameOf(job)),
      el('span', { className: 'word', 'data-tone': TONES[word] ?? '' }, words(word)),
      el('span', { className: 'note' }, job.error ? `${job.error.detail} ${job.error.hint ?? ''}` : facts),
      el('p', { className: 'row' }, ...this.actions(job)));
    if (job.status === 'successful') this.picture(job, node);
    return node;
  }

  actions(job) {
    const name = this.nameOf(job);
    const button = (text, act) => el('button', { type: 'button', className: 'quiet', 'aria-label': `${text}: ${name}`, onclick: act }, text);
    const open = el('a', { className: 'button', href: job.links.view, 'aria-label': `Open: ${name}` }, 'Open');
    if (isActive(job)) return [open, button('Cancel', () => this.act(`/jobs/${job.id}/cancel`, 'POST'))];
    const remove = button('Delete', () => this.act(`/jobs/${job.id}`, 'DELETE'));
    if (job.kind !== 'registration') return [open, remove];
    const again = button('Run again', () => runAgain(this.service, job));
    return job.status === 'successful' ? [open, again, remove, this.choice(job)] : [open, again, remove];
  }

  /** A mark for the comparison of two. */
  choice(job) {
    const box = el('input', { type: 'checkbox', 'aria-label': `Compare: ${this.nameOf(job)}` });
    box.onchange = () => {
      if (box.checked) this.chosen.set(job.id, job);
      else this.chosen.delete(job.id);
      this.mark();
    };
    return el('label', { className: 'check' }, box, el('span', {}, 'Compare'));
  }

  mark() {
    byId('compare').disabled = this.chosen.size !== 2;
  }

  async picture(job, node) {
    try {
      const response = await this.service.request(`/jobs/${job.id}/artifacts/preview.png`, { cache: 'default' });
      node.prepend(await canvasOf(await response.blob(), `${this.nameOf(job)}: before and after`));
    } catch {
      // not every job has one
    }
  }

  async act(path, method) {
    try {
      await this.service.request(path, { method });
      await this.refresh();
    } catch (error) {
      byId('note').textContent = `${error.message} ${error.problem?.hint ?? ''}`;
    }
  }
}
