// One tile an entry of the library: its picture, tags, unit, symmetry, and what can be done with it.

import { el } from './dom.js';
import { number, words } from './format.js';
import { canvasOf, panelsOf } from './pictures.js';
import { sizeOf } from './uploads.js';

const TONES = { ready: 'good', rejected: 'bad', validating: 'warn' };

/** acts: change(entry), remove(entry), choose(tag). */
export function entryTile(service, entry, acts) {
  const { surface_bounds: surface, bounds, unit } = entry;
  const size = sizeOf(surface ?? bounds);
  const facts = [size && `${size}${unit ? ` ${unit}` : ''}`, symmetryWords(entry)].filter(Boolean).join(', ');
  const tags = entry.tags.map((tag) => {
    const chip = el('button', { type: 'button', className: 'quiet', 'aria-label': `Show the tag ${tag}` }, tag);
    chip.onclick = () => acts.choose(tag);
    return chip;
  });
  const node = el('article', { className: 'tile' },
    el('h2', { tabIndex: -1 }, entry.name),
    ...(entry.state === 'ready' ? [] : [el('span', { className: 'word', 'data-tone': TONES[entry.state] }, words(entry.state))]),
    el('span', { className: 'note' }, facts),
    ...(entry.note ? [el('span', { className: 'note' }, entry.note)] : []),
    ...(tags.length ? [el('div', { className: 'tags' }, ...tags)] : []),
    el('p', { className: 'row' }, ...actions(service, entry, acts)));
  if (entry.state === 'ready') picture(service, entry, node);
  return node;
}

/** What is known of an object's symmetry, and from where. */
export function symmetryWords({ symmetry, symmetry_source: source }) {
  if (!symmetry) return 'symmetry not detected yet';
  const { order, axis, continuous } = symmetry;
  const about = axis ? ` about ${axis.map((part) => number(part, 2)).join(', ')}` : '';
  const turns = continuous ? `every rotation${about}` : order > 1 ? `${order} rotations${about}` : 'no symmetry';
  return source === 'said' ? `${turns} (as given)` : turns;
}

function actions(service, entry, acts) {
  const button = (text, act) => {
    const node = el('button', { type: 'button', className: 'quiet', 'aria-label': `${text} ${entry.name}` }, text);
    node.onclick = () => act(entry);
    return node;
  };
  const others = [button('Edit', acts.change), button('Remove', acts.remove)];
  if (entry.state !== 'ready') return others;
  const search = el('a', { className: 'button', href: `${service.root}/?object=${entry.field}` }, 'Search for this');
  return [search, ...others];
}

async function picture(service, entry, node) {
  try {
    node.prepend(await canvasOf(await service.picture(entry.field), `${entry.name}: two views`, panelsOf('object')));
  } catch {
    // not every field has one
  }
}
