// The registrations that this page has started: their phases, and their results in the scene.

import { ApiProblem, told } from './api.js';
import { announce, byId, el, show } from './dom.js';
import { queueWords } from './documents.js';
import { followJob } from './events.js';
import { seconds, sure, words } from './format.js';
import { Turns } from './latest.js';
import { overlayButton, placeWords } from './overlay.js';
import { nameOf } from './uploads.js';

const TONES = { registered: 'good', ambiguous: 'warn', rejected: 'bad' };

export class Runs {
  /** view() is where the scene is shown, with the axis that points up, if it is known. */
  constructor(service, view, options) {
    Object.assign(this, { service, view, options, turns: new Turns() });
  }

  /** Forgets what was started: it goes on, and its result stands on the page of jobs. */
  clear() {
    this.turns.next();
    byId('runs').replaceChildren();
    show(byId('results'), false);
  }

  /** One job for each entry of a list of boxes or marks; with several objects, a search for which of them it is. */
  async start(scene, objects, list, unit = 'auto') {
    this.clear();
    const isLatest = this.turns.next();
    show(byId('results'));
    byId('stage').scrollIntoView(); // on a phone the button lies far below
    await Promise.all(list.boxes.map((entry) => {
      const { id } = entry;
      return this.run({ scene, objects, unit, id, name: list.nameOf(entry), detection: list.detectionOf(entry) }, isLatest);
    }));
  }

  async run({ scene, objects, unit, id, name, detection }, isLatest) {
    const row = el('li', { className: 'run' });
    byId('runs').append(row);
    const began = performance.now();
    try {
      const wanted = objects.length === 1 ? { object: objects[0].sha256 } : { candidates: objects.map(({ sha256 }) => sha256) };
      const request = { scene: scene.sha256, ...wanted, detection, ...this.options.values(this.view().up, unit) };
      let job = await this.service.post('/register', request);
      this.showActive(row, name, job);
      job = await followJob(this.service.job(job.id), job, (news) => this.showActive(row, name, news), () => {});
      if (job.status === 'failed') throw new ApiProblem(422, job.error ?? {});
      if (job.status === 'dismissed') throw new ApiProblem(409, { detail: 'The job was canceled.' });
      const result = await this.service.json(`/jobs/${job.id}/result`);
      if (!isLatest()) return;
      const found = objects.find(({ sha256 }) => sha256 === result.object) ?? objects[0];
      this.showResult(row, name, job, result, found, performance.now() - began);
      const pose = result.T_scene_object.matrix;
      if (result.camera) await this.showOverlay(row, job);
      else if (result.verdict !== 'rejected') await this.view().showFound(this.service, id, found.sha256, pose, isLatest);
    } catch (error) {
      if (!isLatest()) return;
      row.replaceChildren(el('strong', {}, name), el('p', { className: 'bad' }, told(error)));
      announce(`${name}: ${error.message}`);
    }
  }

  showActive(row, name, job) {
    const waits = job.status === 'accepted';
    const text = waits ? queueWords(job) : words(job.phase ?? 'starting');
    if (row.dataset.job !== job.id) {
      row.dataset.job = job.id;
      const cancel = el('button', { type: 'button', className: 'quiet' }, 'Cancel');
      cancel.onclick = () => this.service.job(job.id).cancel().catch(() => {});
      row.replaceChildren(el('strong', {}, name), el('span', {}), el('progress', { max: 1, value: 0, 'aria-label': `Progress of ${name}` }), cancel);
    }
    row.children[1].textContent = text;
    row.children[2].value = job.progress ?? 0;
  }

  showResult(row, name, job, result, object, took) {
    const tone = TONES[result.verdict] ?? 'wait';
    const { probability, level } = result;
    const facts = [
      Number.isFinite(probability) && `probability ${sure(probability, level)}`,
      `scale ${result.T_object_scene.scale.toPrecision(4)}`,
      `${seconds(took / 1000)} since the click on Register`,
    ].filter(Boolean);
    row.replaceChildren(
      el('strong', { 'data-tone': tone }, `${name}, ${words(result.verdict).toLowerCase()}: ${nameOf(object)}`),
      el('span', {}, result.verdict_detail || words(result.verdict_reason)),
      ...(result.verdict_hint ? [el('span', { className: 'note' }, result.verdict_hint)] : []),
      ...(result.camera ? [el('span', {}, placeWords(result))] : []),
      el('span', { className: 'note' }, facts.join(', ')),
      el('p', { className: 'row' }, el('a', { className: 'button', href: job.links.view }, 'Open the result')),
    );
    row.dataset.verdict = result.verdict;
    announce(`${name}: ${words(result.verdict)}`);
  }
  /** The picture comes after the result. */
  async showOverlay(row, job) {
    try {
      row.append(await overlayButton(this.service.job(job.id)));
      row.classList.add('pictured');
    } catch (error) {
      row.append(el('p', { className: 'note' }, `No picture: ${told(error)}`));
    }
  }
}
