// One line for something that goes on: words and a bar.

import { told } from './api.js';
import { el } from './dom.js';

/** { node, step(words, share), fail(error), done() } for what is called `name`. */
export function progressLine(name) {
  const bar = el('progress', { max: 1, value: 0, 'aria-label': name });
  const words = el('span', {});
  const node = el('div', {}, el('div', {}, el('strong', {}, name), ' ', words), bar);
  return {
    node,
    step(text, share) {
      words.textContent = text;
      if (share === null) bar.removeAttribute('value');
      else bar.value = share;
    },
    fail(error) {
      node.replaceChildren(el('p', { className: 'bad' }, `${name}: ${told(error)}`));
    },
    done() {
      node.remove();
    },
  };
}
