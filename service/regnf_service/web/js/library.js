// The library's page: objects by name, with pictures and tags; entries are added, changed, taken out, searched for.

import { told } from './api.js';
import { askFirst } from './confirm.js';
import { byId, el, focusTile, keepPrefix, show } from './dom.js';
import { EntryForm } from './entry-form.js';
import { entryTile } from './entry-tiles.js';
import { Turns } from './latest.js';
import { Service } from './service.js';
import { askForToken } from './token.js';

const service = new Service(askForToken);
const form = new EntryForm(service, refresh);
const turns = new Turns();
const acts = { change: (entry) => form.change(entry), remove, choose: (name) => { byId('tag').value = name; draw(); } };
let entries = [];
let tiles = new Map();

/** Reads the library anew. */
async function refresh() {
  const isLatest = turns.next();
  try {
    const found = await service.all('library');
    if (!isLatest()) return;
    entries = found;
    tiles = new Map(entries.map((entry) => [entry, entryTile(service, entry, acts)]));
    drawTags();
    draw();
  } catch (error) {
    if (isLatest()) byId('note').textContent = told(error);
  }
}

function drawTags() {
  const chosen = byId('tag').value;
  const tags = [...new Set(entries.flatMap((entry) => entry.tags))].sort((a, b) => a.localeCompare(b));
  const options = tags.map((tag) => el('option', { value: tag }, tag));
  byId('tag').replaceChildren(el('option', { value: '' }, 'all tags'), ...options);
  byId('tag').value = tags.includes(chosen) ? chosen : '';
}

function draw() {
  const focused = [...byId('list').children].findIndex((node) => node.contains(document.activeElement));
  const [text, tag] = [byId('search').value.trim().toLowerCase(), byId('tag').value];
  const shown = entries.filter((entry) => entry.name.toLowerCase().includes(text) && (!tag || entry.tags.includes(tag)));
  byId('list').replaceChildren(...shown.map((entry) => tiles.get(entry)));
  byId('note').textContent = entries.length
    ? `${shown.length} of ${entries.length}`
    : 'The library is empty. Add objects: files, or a field of the service.';
  const ready = shown.filter(({ state }) => state === 'ready');
  show(byId('search-these'), ready.length > 1 && !text);
  byId('search-these').textContent = `Search for one of these ${ready.length}`;
  byId('search-these').href = `${service.root}/?tag=${encodeURIComponent(tag)}`;
  if (focused >= 0) focusTile(byId('list'), focused);
}

async function remove(entry) {
  const what = `Remove ${entry.name} from the library?`;
  const lost = 'Its name, tags, unit, note and symmetry are deleted. The field is kept.';
  const act = () => service.request(`/library/${encodeURIComponent(entry.name)}`, { method: 'DELETE' });
  if (await askFirst({ what, lost, verb: 'Remove', act })) await refresh();
}

byId('search').addEventListener('input', draw);
byId('tag').addEventListener('change', draw);
byId('add').addEventListener('click', () => form.add());
keepPrefix(service.root);
addEventListener('pageshow', (event) => { if (event.persisted) refresh(); }); // the way back may show the page as it was left
await refresh();
const asked = new URLSearchParams(location.hash.slice(1)).get('add'); // the service knows no such parameter
if (asked) await form.add(asked);
document.documentElement.dataset.page = 'ready';
