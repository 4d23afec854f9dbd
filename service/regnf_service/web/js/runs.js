// The registrations that this page has started: their phases, and their results in the scene.

import { ApiProblem, told } from './api.js';
import { announce, byId, el, show } from './dom.js';
import { queueWords } from './documents.js';
import { followJob } from './events.js';
import { percent, seconds, words } from './format.js';
import { Turns } from './latest.js';
import { nameOf } from './uploads.js';

const TONES = { registered: 'good', ambiguous: 'warn', rejected: 'bad' };

export class Runs {
  constructor(service, workspace, options) {
    Object.assign(this, { service, workspace, options, turns: new Turns() });
  }

  /** Forgets what was started: it goes on, and its result stands on the page of jobs. */
  clear() {
    this.turns.next();
    byId('runs').replaceChildren();
    show(byId('results'), false);
  }

  /** One job for each box; with several objects, a search for which of them it is. */
  async start(scene, objects, boxes) {
    this.clear();
    const isLatest = this.turns.next();
    show(byId('results'));
    byId('stage').scrollIntoView(); // on a phone the button lies far below
    await Promise.all(boxes.map(({ id, box }) => this.run({ scene, objects, id, box }, isLatest)));
  }

  async run({ scene, objects, id, box }, isLatest) {
    const row = el('li', { className: 'run' });
    byId('runs').append(row);
    const began = performance.now();
    try {
      const wanted = objects.length === 1 ? { object: objects[0].sha256 } : { candidates: objects.map(({ sha256 }) => sha256) };
      const request = { scene: scene.sha256, ...wanted, detection: this.workspace().detectionOf(box), ...this.options.values(this.workspace().up) };
      let job = await this.service.post('/register', request);
      this.showActive(row, id, job);
      job = await followJob(this.service.job(job.id), job, (news) => this.showActive(row, id, news), () => {});
      if (job.status === 'failed') throw new ApiProblem(422, job.error ?? {});
      if (job.status === 'dismissed') throw new ApiProblem(409, { detail: 'The job was canceled.' });
      const result = await this.service.json(`/jobs/${job.id}/result`);
      if (!isLatest()) return;
      const found = objects.find(({ sha256 }) => sha256 === result.object) ?? objects[0];
      this.showResult(row, id, job, result, found, performance.now() - began);
      const pose = result.T_scene_object.matrix;
      if (result.verdict !== 'rejected') await this.workspace().showFound(this.service, id, found.sha256, pose, isLatest);
    } catch (error) {
      if (!isLatest()) return;
      row.replaceChildren(el('strong', {}, `Box ${id}`), el('p', { className: 'bad' }, told(error)));
      announce(`Box ${id}: ${error.message}`);
    }
  }

  showActive(row, id, job) {
    const waits = job.status === 'accepted';
    const text = waits ? queueWords(job) : words(job.phase ?? 'starting');
    if (row.dataset.job !== job.id) {
      row.dataset.job = job.id;
      const cancel = el('button', { type: 'button', className: 'quiet' }, 'Cancel');
      cancel.onclick = () => this.service.job(job.id).cancel().catch(() => {});
      row.replaceChildren(el('strong', {}, `Box ${id}`), el('span', {}), el('progress', { max: 1, value: 0, 'aria-label': `Progress of box ${id}` }), cancel);
    }
    row.children[1].textContent = text;
    row.children[2].value = job.progress ?? 0;
  }

  showResult(row, id, job, result, object, took) {
    const tone = TONES[result.verdict] ?? 'wait';
    const { probability } = result;
    const facts = [
      Number.isFinite(probability) && `probability ${percent(probability, 1)}`,
      `scale ${result.T_object_scene.scale.toPrecision(4)}`,
      `${seconds(took / 1000)} from the click on Register`,
    ].filter(Boolean);
    row.replaceChildren(
      el('strong', { 'data-tone': tone }, `Box ${id}, ${words(result.verdict).toLowerCase()}: ${nameOf(object)}`),
      el('span', {}, result.verdict_detail || words(result.verdict_reason)),
      ...(result.verdict_hint ? [el('span', { className: 'note' }, result.verdict_hint)] : []),
      el('span', { className: 'note' }, facts.join(', ')),
      el('p', { className: 'row' }, el('a', { className: 'button', href: job.links.view }, 'Look closer')),
    );
    row.dataset.verdict = result.verdict;
    announce(`Box ${id}: ${words(result.verdict)}`);
  }
}
