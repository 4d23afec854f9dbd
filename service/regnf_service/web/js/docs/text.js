// Descriptions of the contract as elements: paragraphs, with `code` marked. Text goes in as text.

import { el } from '../dom.js';

export function paragraphs(text) {
  return text.trim().split('\n\n').filter(Boolean).map((part) => el('p', {}, ...inline(part)));
}

export function inline(text) {
  return text.split('`').map((part, index) => (index % 2 ? el('code', {}, part) : part));
}

export function table(heads, rows) {
  const head = el('tr', {}, ...heads.map((text) => el('th', { scope: 'col' }, text)));
  const body = rows.map((cells) => el('tr', {}, ...cells.map((cell) => el('td', {}, ...[cell].flat()))));
  return el('table', {}, el('thead', {}, head), el('tbody', {}, ...body));
}
