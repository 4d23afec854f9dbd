// The lists of jobs and of fields: names, states, pictures, filters, and what can be done with each.

import { byId, el, show } from './dom.js';
import { FieldTiles } from './field-tiles.js';
import { words } from './format.js';
import { JobTiles } from './job-tiles.js';
import { Service } from './service.js';
import { askForToken, keepPrefix } from './token.js';

const STATES = {
  jobs: ['accepted', 'running', 'successful', 'failed', 'dismissed', 'registered', 'ambiguous', 'rejected'],
  fields: ['validating', 'ready', 'rejected'],
};

const service = new Service(askForToken);
const what = location.pathname.endsWith('/fields') ? 'fields' : 'jobs';
const kind = what === 'fields' ? new FieldTiles(service, refresh) : new JobTiles(service, refresh);

/** Reads the list anew. */
async function refresh() {
  try {
    await kind.load();
    draw();
  } catch (error) {
    byId('note').textContent = `${error.message} ${error.problem?.hint ?? ''}`;
  }
}

function draw() {
  const [text, state] = [byId('search').value.trim().toLowerCase(), byId('state').value];
  const shown = kind.entries.filter((entry) => entry.text.toLowerCase().includes(text) && (!state || entry.states.includes(state)));
  byId('list').replaceChildren(...shown.map((entry) => entry.node));
  byId('note').textContent = kind.entries.length ? `${shown.length} of ${kind.entries.length}` : kind.empty;
}

byId('title').textContent = words(what);
document.title = `${words(what)} – regnf`;
document.querySelector(`.nav [data-to="/${what}"]`).setAttribute('aria-current', 'page');
byId('state').append(...STATES[what].map((state) => el('option', { value: state }, words(state))));
byId('search').addEventListener('input', draw);
byId('state').addEventListener('change', draw);
show(byId('compare'), what === 'jobs');
keepPrefix(service.root);
await refresh();
document.documentElement.dataset.page = 'ready';
