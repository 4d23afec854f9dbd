// Every metric with a sentence that says what it is. The sentences are those of docs/reference/metrics.md.

import { isShare, readSentences } from './documents.js';
import { byId, el, fillFacts, show } from './dom.js';
import { number, percent, words } from './format.js';

/** Shares as bars, the others as numbers. Without the sentences, as behind a broken connection, the names must do. */
export async function showAgreement(metrics = {}) {
  const about = await readSentences();
  const titleOf = (name) => about[name]?.title ?? words(name);
  const shares = Object.entries(metrics).filter(([name, value]) => isShare(name, value));
  byId('shares').replaceChildren(...shares.map(([name, value]) => shareBar(titleOf(name), value, sentence(about[name]))));
  const others = Object.entries(metrics).filter(
    ([name, value]) => Number.isFinite(value) && !name.startsWith('seconds') && !shares.some(([share]) => share === name),
  );
  fillFacts(byId('metrics'), others.map(([name, value]) => [titleOf(name), withSentence(number(value), sentence(about[name]))]));
  show(byId('agreement'), shares.length + others.length > 0);
}

const sentence = (about) => (about ? `${about.meaning}.${about.good ? ` Good: ${about.good}.` : ''}` : '');

function shareBar(name, share, about) {
  const fill = el('span', {});
  fill.style.width = `${share * 100}%`;
  return el('div', { className: 'share' }, el('span', {}, name), el('span', { className: 'mono' }, percent(share)),
    el('span', { className: 'track', 'aria-hidden': 'true' }, fill), el('small', {}, about));
}

const withSentence = (value, about) => el('span', {}, el('span', { className: 'mono' }, value), el('small', {}, about));
