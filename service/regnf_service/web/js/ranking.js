// The ranking of a search through a library: which object it most likely is, and what became of the others.

import { byId, el, show } from './dom.js';
import { number, percent, sure, words } from './format.js';

const SHOWN = 8;
const STAGES = {
  refined: 'refined', coarse: 'coarse search', signature: 'by signature', unusable: 'unusable',
};

/** candidates as the result has them, the likeliest first; the rest folds away. */
export function showRanking(names, candidates) {
  const rows = (candidates ?? []).map((one, i) => row(one, i));
  nameRows(names, rows.slice(0, SHOWN));
  byId('ranking-more').ontoggle = () => nameRows(names, rows.slice(SHOWN));
  byId('ranking-note').textContent = rows.length ? `${rows.length} candidates` : '';
  byId('ranking-list').replaceChildren(...rows.slice(0, SHOWN));
  byId('ranking-rest').replaceChildren(...rows.slice(SHOWN));
  show(byId('ranking-more'), rows.length > SHOWN);
  show(byId('ranking'), rows.length > 0);
}

/** Puts the objects' names in place of their digests; the folded ones are asked for once they are seen. */
async function nameRows(names, rows) {
  for (const node of rows.map((one) => one.querySelector('[data-object]'))) {
    node.textContent = await names.of(node.dataset.object);
  }
}

function row({ object, stage, score, verdict, verdict_reason: reason, probability, level, difference }, i) {
  const name = el('span', { title: object, 'data-object': object }, object.slice(0, 12));
  const judged = Number.isFinite(probability) ? `${words(verdict)}, ${sure(probability, level)}` : words(verdict);
  const end = verdict ? judged : STAGES[stage] ?? stage;
  return el('li', { 'data-verdict': verdict ?? '', className: i === 0 ? 'first' : '' }, name,
    el('span', { title: reason ?? '' }, end),
    el('span', { className: 'mono' }, Number.isFinite(score) ? number(score, 3) : '–'),
    difference ? el('span', { className: 'note' }, toldApart(difference)) : '');
}

/** Whether what was seen tells a candidate from the first one. */
function toldApart({ distinguishable, seen }) {
  if (!distinguishable) return 'cannot be distinguished from the first by the observed surface';
  return `distinguished from the first by ${percent(seen)} of the surface, which was observed`;
}
