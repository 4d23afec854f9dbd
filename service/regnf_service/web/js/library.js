// The library's page: objects by name, with pictures and tags; entries are added, changed, taken out, searched for.

import { byId, el, show } from './dom.js';
import { EntryForm } from './entry-form.js';
import { entryTile } from './entry-tiles.js';
import { Service } from './service.js';
import { askForToken, keepPrefix } from './token.js';

const service = new Service(askForToken);
const form = new EntryForm(service, refresh);
let entries = [];

/** Reads the library anew. */
async function refresh() {
  try {
    entries = await service.all('library');
    drawTags();
    draw();
  } catch (error) {
    tell(error);
  }
}

function tell(error) {
  byId('note').textContent = `${error.message} ${error.problem?.hint ?? ''}`;
}

function drawTags() {
  const chosen = byId('tag').value;
  const tags = [...new Set(entries.flatMap((entry) => entry.tags))].sort((a, b) => a.localeCompare(b));
  const options = tags.map((tag) => el('option', { value: tag }, tag));
  byId('tag').replaceChildren(el('option', { value: '' }, 'every tag'), ...options);
  byId('tag').value = tags.includes(chosen) ? chosen : '';
}

function draw() {
  const [text, tag] = [byId('search').value.trim().toLowerCase(), byId('tag').value];
  const shown = entries.filter((entry) => entry.name.toLowerCase().includes(text) && (!tag || entry.tags.includes(tag)));
  const acts = { change: (entry) => form.change(entry), remove, choose: (name) => { byId('tag').value = name; draw(); } };
  byId('list').replaceChildren(...shown.map((entry) => entryTile(service, entry, acts)));
  byId('note').textContent = entries.length
    ? `${shown.length} of ${entries.length}`
    : 'Nothing in the library yet. Add an object: a file, or a field that the service has.';
  const ready = shown.filter(({ state }) => state === 'ready');
  show(byId('search-these'), ready.length > 1 && !text);
  byId('search-these').textContent = `Search for one of these ${ready.length}`;
  byId('search-these').href = `${service.root}/?tag=${encodeURIComponent(tag)}`;
}

async function remove(entry) {
  try {
    await service.request(`/library/${encodeURIComponent(entry.name)}`, { method: 'DELETE' });
    await refresh();
  } catch (error) {
    tell(error);
  }
}

byId('search').addEventListener('input', draw);
byId('tag').addEventListener('change', draw);
byId('add').addEventListener('click', () => form.add());
keepPrefix(service.root);
await refresh();
const asked = new URLSearchParams(location.hash.slice(1)).get('add'); // the service knows no such parameter
if (asked) await form.add(asked);
document.documentElement.dataset.page = 'ready';
