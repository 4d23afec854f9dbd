// Asks for an access token, once for everybody who waits for it.

import { byId } from './dom.js';

let asked = null;

/** The token, once somebody has entered it. */
export function askForToken() {
  asked ??= new Promise((resolve) => {
    const dialog = byId('token-dialog');
    dialog.addEventListener('cancel', (event) => event.preventDefault());
    byId('token-form').addEventListener('submit', () => {
      asked = null;
      const token = byId('token').value.trim();
      byId('token').value = '';
      resolve(token);
    }, { once: true });
    if (!dialog.open) dialog.showModal();
  });
  return asked;
}
