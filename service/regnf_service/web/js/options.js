// The options that a result was made with: those of its preset's groups.

import { byId, el, show } from './dom.js';
import { number, words } from './format.js';

const GROUPS = { robust: ['robust'], paper: ['sampling', 'initialization', 'optimization', 'resampling'] };

export function showOptions(options) {
  const preset = options?.preset;
  const groups = (GROUPS[preset] ?? []).filter((name) => options[name] && typeof options[name] === 'object');
  byId('preset').textContent = preset ? `preset ${preset}` : '';
  byId('option-groups').replaceChildren(...groups.flatMap((name) => [
    ...(groups.length > 1 ? [el('h3', {}, words(name))] : []),
    el('dl', { className: 'facts' }, ...Object.entries(options[name]).map(([option, value]) => el(
      'div', {}, el('dt', {}, option), el('dd', { className: 'mono' }, shown(value)),
    ))),
  ]));
  show(byId('options'), Boolean(preset));
}

const shown = (value) => (typeof value === 'number' ? number(value) : value === null ? 'none' : String(value));
