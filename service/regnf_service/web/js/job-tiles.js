// One tile a job: whose objects and scene, its verdict, and what can be done with it.

import { told, toldOf } from './api.js';
import { compareJobs } from './compare.js';
import { askFirst, deletionOf } from './confirm.js';
import { byId, el } from './dom.js';
import { isActive, queueWords } from './documents.js';
import { moment, seconds, sure, words } from './format.js';
import { boxOfJob, isInImage, shortOf, titleOfJob } from './names.js';
import { overlayButton } from './overlay.js';
import { canvasOf } from './pictures.js';
import { canRunAgain, runAgain } from './run-again.js';
import { nameOf } from './uploads.js';

const TONES = {
  registered: 'good', ambiguous: 'warn', rejected: 'bad', failed: 'bad', accepted: 'warn', running: 'warn', successful: 'good',
};

export class JobTiles {
  constructor(service, store, refresh) {
    Object.assign(this, { service, store, refresh, chosen: new Map() });
    this.empty = 'No jobs yet. Start one on the page Register.';
    byId('compare').addEventListener('click', () => compareJobs(service, [...this.chosen.values()], this));
  }

  entries() {
    const { jobs } = this.store;
    for (const id of this.chosen.keys()) if (!jobs.some((job) => job.id === id)) this.chosen.delete(id);
    this.mark();
    return jobs.map((job) => ({ text: this.nameOf(job), states: [job.status, job.verdict], node: this.tile(job) }));
  }

  /** The chair in the room. */
  nameOf(job) {
    const fields = [...this.store.fields, ...this.store.recordings];
    return titleOfJob(job, (sha256) => {
      const field = fields.find((one) => one.sha256 === sha256);
      return field ? nameOf(field) : shortOf(sha256);
    });
  }

  tile(job) {
    const word = job.verdict ?? job.status;
    const node = el('article', { className: 'tile' },
      el('h2', { tabIndex: -1 }, this.nameOf(job)),
      el('span', { className: 'word', 'data-tone': TONES[word] ?? '' }, words(word)),
      ...this.lines(job).filter(Boolean).map((line) => el('span', { className: 'note' }, line)),
      el('p', { className: 'row' }, ...this.actions(job)));
    if (job.status === 'successful') this.picture(job, node);
    return node;
  }

  lines(job) {
    const { candidates } = job.inputs;
    const took = job.finished_at ? seconds((Date.parse(job.finished_at) - Date.parse(job.created_at)) / 1000) : null;
    const times = [moment(job.created_at), took && `${took} from request to end`, `seed ${job.inputs.seed ?? 0}`];
    return [
      job.error && toldOf(job.error),
      job.status === 'accepted' && queueWords(job),
      candidates && job.object_found && job.verdict !== 'rejected' && `the most probable of ${candidates} objects`,
      Number.isFinite(job.probability) && `probability ${sure(job.probability, job.level)}`,
      boxOfJob(job),
      times.filter(Boolean).join(', '),
    ];
  }

  actions(job) {
    const name = this.nameOf(job);
    const button = (text, act) => {
      const node = el('button', { type: 'button', className: 'quiet', 'aria-label': `${text}: ${name}` }, text);
      node.onclick = () => act(node);
      return node;
    };
    const open = el('a', { className: 'button', href: job.links.view, 'aria-label': `Open: ${name}` }, 'Open');
    if (isActive(job)) return [open, button('Cancel', (node) => this.cancel(job, node))];
    const remove = button('Delete', () => this.remove(job));
    if (!canRunAgain(job)) return [open, remove];
    const again = button('Run again', () => runAgain(this.service, job));
    return job.status === 'successful' ? [open, again, remove, this.choice(job)] : [open, again, remove];
  }

  /** A mark for the comparison of two. */
  choice(job) {
    const box = el('input', { type: 'checkbox', checked: this.chosen.has(job.id), autocomplete: 'off', 'aria-label': `Compare: ${this.nameOf(job)}` });
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
      if (isInImage(job)) return node.prepend(await overlayButton(this.service.job(job.id)));
      const response = await this.service.request(`/jobs/${job.id}/artifacts/preview.png`, { cache: 'default' });
      const canvas = await canvasOf(await response.blob(), `${this.nameOf(job)}: before and after`, [0, 1]);
      node.prepend(el('figure', {}, canvas, el('figcaption', { className: 'note' }, el('span', {}, 'before'), el('span', {}, 'after'))));
    } catch {
      // not every job has one
    }
  }

  async cancel(job, node) {
    node.disabled = true;
    try {
      await this.service.request(`/jobs/${job.id}/cancel`, { method: 'POST' });
      await this.refresh();
    } catch (error) {
      byId('note').textContent = told(error);
      node.disabled = false;
    }
  }

  async remove(job) {
    if (await askFirst(deletionOf(this.service, job, this.nameOf(job)))) await this.refresh();
  }
}
