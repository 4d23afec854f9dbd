// One operation: a line that opens to its parameters, bodies, answers and the form that tries it.

import { el } from '../dom.js';
import { nameOf, typeOf } from './contract.js';
import { inline, paragraphs, table } from './text.js';
import { tryForm } from './try-it.js';

export function operationNode(operation) {
  const line = el('summary', {},
    el('span', { className: 'method', 'data-method': operation.method }, operation.method.toUpperCase()),
    el('code', {}, operation.path), el('span', { className: 'hint' }, operation.summary));
  const node = el('details', { className: 'operation', id: operation.id }, line);
  node.addEventListener('toggle', () => {
    if (node.open && node.children.length === 1) node.append(content(operation));
  });
  return node;
}

function content(operation) {
  return el('div', {}, ...paragraphs(operation.description), ...parameters(operation), ...bodies(operation),
    ...answers(operation), tryForm(operation));
}

function parameters({ parameters: list }) {
  if (list.length === 0) return [];
  const rows = list.map((one) => [
    el('code', {}, one.name), `${one.in}${one.required ? ', required' : ''}`, typeOf(one.schema), inline(one.description ?? ''),
  ]);
  return [table(['Parameter', 'In', 'Type', ''], rows)];
}

function bodies({ bodies: contents }) {
  return Object.entries(contents).map(([mediaType, body]) =>
    el('p', {}, 'Body ', el('code', {}, mediaType), ' ', ...typeLinks(body.schema)));
}

function answers({ answers: list }) {
  const rows = Object.entries(list).map(([status, answer]) => [
    el('code', {}, status), reasonLinks(answer.description), Object.values(answer.content ?? {}).flatMap((one) => typeLinks(one.schema)),
  ]);
  return [table(['Answer', '', 'Body'], rows)];
}

/** Refusals are named in `code`: links to what they mean. */
function reasonLinks(text) {
  return text.split('`').map((part, index) => {
    if (index % 2 === 0) return part;
    return /^[A-Z_]+$/.test(part) ? el('a', { href: `#${part}` }, el('code', {}, part)) : el('code', {}, part);
  });
}

function typeLinks(schema = {}) {
  if (schema.$ref) return [el('a', { href: `#${nameOf(schema.$ref)}` }, nameOf(schema.$ref))];
  return (schema.anyOf ?? schema.oneOf ?? []).flatMap((one, index) => (index ? [' or ', ...typeLinks(one)] : typeLinks(one)));
}
