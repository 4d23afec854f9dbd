// Asks before something is gone for good.

import { told } from './api.js';
import { el } from './dom.js';

/**
 * Opens a dialog; what: the question, lost: what goes with it, verb: the button that does it. Does act() and closes, or
 * says why that failed and stays. The promise is true once it was done, and false for who has changed their mind.
 */
export function askFirst({ what, lost, verb, act }) {
  const note = el('p', { className: 'bad', role: 'alert' });
  const keep = el('button', { type: 'button', autofocus: true }, 'Keep');
  const go = el('button', { type: 'button', className: 'solid danger' }, verb);
  const title = el('h2', { id: 'ask-title' }, what);
  const dialog = el('dialog', { 'aria-labelledby': title.id }, title, el('p', { className: 'note' }, lost), note, el('div', { className: 'row end' }, keep, go));
  document.body.append(dialog);
  return new Promise((resolve) => {
    let done = false;
    dialog.addEventListener('close', () => {
      dialog.remove();
      resolve(done);
    });
    keep.onclick = () => dialog.close();
    go.onclick = async () => {
      go.disabled = true;
      try {
        await act();
        done = true;
        dialog.close();
      } catch (error) {
        note.textContent = told(error);
        go.disabled = false;
        keep.textContent = 'Close';
      }
    };
    dialog.showModal();
  });
}

/** What is asked before a job is deleted, and done. */
export const deletionOf = (service, job, name) => ({
  what: `Delete the job “${name}”?`,
  lost: 'Its result, pictures and files are deleted. The fields are kept.',
  verb: 'Delete',
  act: () => service.request(`/jobs/${job.id}`, { method: 'DELETE' }),
});
