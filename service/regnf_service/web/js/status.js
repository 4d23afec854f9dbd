// The badge in the bar and the card in the view's place: loading, running, failed, dismissed, not found.

import { ApiProblem, toldOf } from './api.js';
import { isActive, phasesOf } from './documents.js';
import { byId, el, fillFacts, show } from './dom.js';
import { words } from './format.js';
import { canRunAgain } from './run-again.js';

const TONES = {
  accepted: 'wait', running: 'wait', successful: 'good', failed: 'bad', dismissed: 'still',
  registered: 'good', ambiguous: 'warn', rejected: 'bad',
};

/** The badge, the page's title and, for screen readers, the spoken status. */
export function showBadge(word, jobId = '') {
  const badge = byId('status');
  badge.dataset.tone = TONES[word] ?? 'wait';
  if (badge.textContent !== words(word)) badge.textContent = words(word);
  document.title = `${words(word)}${jobId ? ` · job ${jobId.slice(0, 8)}` : ''} – regnf`;
}

export function showLoading(text) {
  card({ eyebrow: 'Loading', title: text, tone: 'wait' });
}

/** An accepted or running job: its phase, its place in the queue, how far it is. */
export function showActive(job) {
  showBadge(job.status, job.id);
  const queued = job.status === 'accepted';
  const ahead = job.queue_position - 1; // 1 is next
  card({
    eyebrow: queued ? 'Waiting for a worker' : runningText(job.attempts ?? job.attempt ?? 1),
    title: queued ? 'In the queue' : words(job.phase ?? 'starting'),
    text: queued ? queueText(ahead) : `${Math.round((job.progress ?? 0) * 100)} % done`,
    tone: 'wait',
  });
  show(byId('message-progress'), !queued);
  show(byId('cancel'), isActive(job) && !job.cancel_requested);
  byId('progress').value = job.progress ?? 0;
  showPhases(phasesOf(job), job.phase);
}

export function showTrouble(error) {
  if (error) byId('message-text').textContent = 'The service does not respond. Trying again.';
}

/** A failed job's own problem object. */
export function showFailed(job) {
  showBadge('failed', job.id);
  const problem = job.error ?? {};
  card({ eyebrow: 'The job failed', title: titleOf(problem), text: toldOf({ ...problem, hint: null, title: null }), tone: 'bad' });
  showProblem(problem);
}

export function showDismissed(job) {
  const again = canRunAgain(job) ? 'Press Run again to start it again.' : 'Start it again on the page Register.';
  showBadge('dismissed', job.id);
  card({ eyebrow: 'No result', title: 'The job was dismissed', text: `It was canceled before it had a result. ${again}`, tone: 'still' });
}

/** A refusal of the service, or a broken connection. onRetry is offered where trying again makes sense. */
export function showError(error, onRetry) {
  const problem = error instanceof ApiProblem ? error.problem : {};
  const titles = { 401: 'This service needs a token', 403: 'Not allowed', 404: 'This job does not exist', 410: 'The job has expired' };
  showBadge('unavailable');
  byId('status').dataset.tone = 'bad';
  card({
    eyebrow: error.status ? `The service responded with ${error.status}` : 'No connection',
    title: titles[error.status] ?? problem.title ?? 'The job could not be loaded',
    text: toldOf({ ...problem, detail: error.message, hint: null }),
    tone: error.status === 401 ? 'wait' : 'bad',
  });
  showProblem(problem);
  show(byId('token-form'), error.status === 401);
  show(byId('retry'), error.status !== 401);
  byId('retry').onclick = onRetry;
}

/** The results are there, but the 3D view cannot be shown. */
export function showNoView(error) {
  card({ eyebrow: 'The results are complete', title: 'The 3D view cannot be displayed', text: error.message, tone: 'warn' });
}

/** A job of a kind that has no pose to look at. */
export function showFilesOnly() {
  card({ eyebrow: 'Finished', title: 'The job wrote files', text: 'This kind of job has no pose.', tone: 'good' });
}

export function showNumbersOnly() {
  const text = 'The request of this registration has no pictures. Its pose and its metrics are next to this text.';
  card({ eyebrow: 'Finished', title: 'There are no pictures', text, tone: 'good' });
}

export function hideCard() {
  show(byId('message'), false);
}

function card({ eyebrow, title, text = '', tone }) {
  const message = byId('message');
  message.dataset.tone = tone;
  byId('message-eyebrow').textContent = eyebrow;
  byId('message-title').textContent = title;
  byId('message-text').textContent = text;
  for (const id of ['message-progress', 'message-hint', 'message-facts', 'token-form', 'cancel', 'retry']) show(byId(id), false);
  show(message);
}

function showProblem(problem) {
  const hint = problem.hint ?? '';
  byId('message-hint').textContent = hint;
  show(byId('message-hint'), hint !== '');
  const code = problem.reason ? el('code', {}, problem.reason) : null;
  fillFacts(byId('message-facts'), [['Reason', code], ['Request', problem.request_id ?? null]]);
}

function showPhases(phases, current) {
  const at = phases.indexOf(current);
  byId('phases').replaceChildren(...phases.map((phase, i) => {
    const state = i < at ? 'done' : i === at ? 'now' : 'next';
    const item = el('li', { 'data-state': state }, words(phase));
    if (state === 'now') item.setAttribute('aria-current', 'step');
    return item;
  }));
}

// A problem without a title of its own has its reason as title.
const titleOf = ({ title, reason }) => (title && title !== reason ? title : words(reason ?? 'failed'));

const runningText = (attempt) => (attempt > 1 ? `Running, attempt ${attempt}` : 'Running');

function queueText(ahead) {
  if (!Number.isFinite(ahead)) return 'Waiting for the next free worker.';
  return ahead <= 0 ? 'This job is next.' : `${ahead} ${ahead === 1 ? 'job is' : 'jobs are'} ahead of it.`;
}
