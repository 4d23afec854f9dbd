// What a refused field may be, where nothing in its file tells: of each candidate a picture and what to say to get it.

import { byId, copyText, el, show } from './dom.js';
import { canvasOf } from './pictures.js';

/** Shows the candidates of a failed job's fields, as long as their uploads are kept. */
export async function showCandidates(api, job) {
  if (job.error?.reason !== 'FIELD_REJECTED') return;
  const named = [['Scene', job.inputs?.scene], ['Object', job.inputs?.object]];
  const fields = named.filter(([, sha256]) => /^[0-9a-f]{64}$/.test(sha256));
  const lists = await Promise.all(fields.map(([name, sha256]) => listOf(api, name, sha256)));
  byId('candidate-list').replaceChildren(...lists.flat());
  show(byId('candidates'), lists.flat().length > 0);
}

async function listOf(api, name, sha256) {
  try {
    const candidates = (await api.field(sha256)).error?.candidates ?? [];
    return await Promise.all(candidates.map((one, i) => figureOf(api, `${name} ${i + 1}`, sha256, one, i + 1)));
  } catch {
    return []; // the field may be gone
  }
}

async function figureOf(api, heading, sha256, candidate, number) {
  const said = JSON.stringify(candidate.description);
  const copy = el('button', { type: 'button', className: 'quiet', 'aria-label': `Copy the import option for ${heading}` }, 'Copy');
  copy.addEventListener('click', () => copyText(said, copy));
  const line = el('div', { className: 'row' }, el('code', {}, said), copy);
  const caption = el('figcaption', { className: 'note' }, `${heading}: ${candidate.name}`);
  return el('figure', {}, ...await pictureOf(api, heading, sha256, candidate, number), caption, line);
}

async function pictureOf(api, heading, sha256, candidate, number) {
  if (!candidate.picture) return [];
  try {
    const label = `${heading}: its surface from two sides, and a section`;
    return [await canvasOf(await api.candidatePicture(sha256, number), label)];
  } catch {
    return []; // its time was over in between
  }
}
