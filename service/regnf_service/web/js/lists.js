// The lists of jobs and of fields: names, states, pictures, filters, and what can be done with each.

import { told } from './api.js';
import { byId, el, focusTile, keepPrefix, show } from './dom.js';
import { FieldStore } from './field-store.js';
import { FieldTiles } from './field-tiles.js';
import { words } from './format.js';
import { JobTiles } from './job-tiles.js';
import { Service } from './service.js';
import { askForToken } from './token.js';

const STATES = {
  jobs: ['accepted', 'running', 'successful', 'failed', 'dismissed', 'registered', 'ambiguous', 'rejected'],
  fields: ['validating', 'ready', 'rejected'],
};

const service = new Service(askForToken);
const store = new FieldStore(service);
const what = location.pathname.endsWith('/fields') ? 'fields' : 'jobs';
const kind = what === 'fields' ? new FieldTiles(service, store, refresh) : new JobTiles(service, store, refresh);
let entries = [];
store.onChange(() => {
  entries = kind.entries();
  draw();
});

/** Reads the list anew. */
async function refresh() {
  try {
    await store.load();
  } catch (error) {
    byId('note').textContent = told(error);
  }
}

/** Draws what the store knows; the tile that had the focus, or the one in its place, has it again. */
function draw() {
  const focused = [...byId('list').children].findIndex((node) => node.contains(document.activeElement));
  const [text, state] = [byId('search').value.trim().toLowerCase(), byId('state').value];
  const shown = entries.filter((entry) => entry.text.toLowerCase().includes(text) && (!state || entry.states.includes(state)));
  byId('list').replaceChildren(...shown.map((entry) => entry.node));
  byId('note').textContent = entries.length ? `${shown.length} of ${entries.length}` : kind.empty;
  if (focused >= 0) focusTile(byId('list'), focused);
}

byId('title').textContent = words(what);
document.title = `${words(what)} – regnf`;
document.querySelector(`.nav [data-to="/${what}"]`).setAttribute('aria-current', 'page');
byId('state').append(...STATES[what].map((state) => el('option', { value: state }, words(state))));
byId('search').addEventListener('input', draw);
byId('state').addEventListener('change', draw);
show(byId('compare'), what === 'jobs');
keepPrefix(service.root);
addEventListener('pageshow', (event) => { if (event.persisted) refresh(); }); // the way back may show the page as it was left
await refresh();
document.documentElement.dataset.page = 'ready';
