// The same registration with other options: a form that begins with those of the earlier job.

import { told } from './api.js';
import { el } from './dom.js';
import { OptionsForm } from './options-form.js';

/** Whether a job that has ended can be asked for again with other options. */
export const canRunAgain = ({ kind }) => kind === 'registration';

/** Opens the form for a registration that has ended. */
export async function runAgain(service, job) {
  const host = el('div', { className: 'options-form', id: 'again-options' });
  const note = el('p', { className: 'bad', role: 'alert' });
  const start = el('button', { type: 'button', className: 'solid', id: 'again-start', disabled: true }, 'Register');
  const close = el('button', { type: 'button' }, 'Close');
  const title = el('h2', { id: 'again-title' }, 'Run again with other options');
  const dialog = el('dialog', { id: 'again-dialog', 'aria-labelledby': title.id }, title, host, note, el('div', { className: 'row end' }, close, start));
  close.onclick = () => dialog.close();
  dialog.addEventListener('close', () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal(); // at once: nothing else can be clicked while the answer is on its way
  try {
    const request = await service.json(`/jobs/${job.id}/request`);
    const form = new OptionsForm(host, service, request.options, request.seed);
    await form.load();
    start.onclick = () => post(service, requestOf(request, form), start, note);
    start.disabled = false;
  } catch (error) {
    note.textContent = told(error);
  }
}

/** The earlier request with what the form says; options that the form does not show stay as they were. */
function requestOf(request, form) {
  const { robust: _, up_axis: up, ...others } = request.options;
  const { options, seed } = form.values(up ?? 'z');
  return { ...request, seed, options: { ...others, ...options } };
}

async function post(service, request, start, note) {
  start.disabled = true;
  note.textContent = '';
  try {
    location.href = (await service.post('/register', request)).links.view;
  } catch (error) {
    note.textContent = told(error);
    start.disabled = false;
  }
}
