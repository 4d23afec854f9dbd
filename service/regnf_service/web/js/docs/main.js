// The page of the contract: reads openapi.json, fills navigation and operations, follows the search and the address.

import { byId, el, keepPrefix, show } from '../dom.js';
import { Turns } from '../latest.js';
import { byTag, matches, operationsOf } from './contract.js';
import { operationNode } from './operation.js';
import { inline, paragraphs } from './text.js';
import { token } from './token.js';

const turns = new Turns();
const ROOT = window.location.pathname.replace(/\/docs\/?$/, '');

async function load() {
  const isLatest = turns.next(); // with an older token the answer may come later
  const headers = token.value ? { Authorization: `Bearer ${token.value}` } : {};
  const response = await fetch(`${ROOT}/openapi.json`, { headers });
  if (!isLatest()) return;
  if (response.status === 401) return complain('This service asks for an access token. Enter yours below.');
  if (!response.ok) return complain(`The contract did not come: the service answered ${response.status}.`);
  show(byId('problem'), false);
  fill(await response.json());
  follow();
  document.documentElement.dataset.page = 'ready';
}

function complain(text) {
  byId('problem').textContent = text;
  show(byId('problem'));
  document.documentElement.dataset.page = 'refused';
}

function fill(contract) {
  byId('title').textContent = `HTTP interface ${contract.info.version}`;
  const files = ['openapi.yaml', 'openapi.json'].map((name) => el('a', { href: `${ROOT}/${name}` }, name));
  byId('about').replaceChildren(...paragraphs(contract.info.description), el('p', {}, 'For programs: ', files[0], ', ', files[1]));
  const groups = byTag(contract, operationsOf(contract)).map(groupOf);
  byId('navigation').replaceChildren(...groups.map((group) => group.links));
  byId('operations').replaceChildren(...groups.map((group) => group.section));
  fillReasons(contract['x-reasons'] ?? {});
  fillSchemas(contract.components.schemas);
  byId('search').oninput = () => filter(groups);
}

function groupOf({ name, description = '', operations }) {
  const title = name.charAt(0).toUpperCase() + name.slice(1);
  const entries = operations.map((operation) => ({
    operation,
    node: operationNode(operation),
    link: el('a', { href: `#${operation.id}` }, `${operation.method.toUpperCase()} ${operation.path}`),
  }));
  const links = el('div', {}, el('h2', {}, title), ...entries.map(({ link }) => link));
  const section = el('section', {}, el('h2', {}, title), el('p', {}, ...inline(description)), ...entries.map(({ node }) => node));
  return { links, section, entries };
}

function fillReasons(reasons) {
  const rows = Object.entries(reasons).flatMap(([name, { status, meaning }]) => [
    el('dt', { id: name }, `${name} (${status})`), el('dd', {}, ...inline(meaning)),
  ]);
  byId('reason-list').replaceChildren(...rows);
  show(byId('reasons'), rows.length > 0);
}

function fillSchemas(schemas) {
  byId('schema-list').replaceChildren(...Object.entries(schemas).map(([name, schema]) => {
    const node = el('details', { className: 'schema', id: name }, el('summary', {}, el('code', {}, name), el('span', { className: 'hint' }, firstLine(schema))));
    node.addEventListener('toggle', () => {
      if (node.open && node.children.length === 1) node.append(el('div', {}, el('pre', { tabIndex: 0 }, JSON.stringify(schema, null, 2))));
    });
    return node;
  }));
  show(byId('schemas'));
}

const firstLine = ({ description = '' }) => description.split('\n')[0];

function filter(groups) {
  const words = byId('search').value.trim();
  let found = 0;
  for (const { links, section, entries } of groups) {
    const shown = entries.filter(({ operation, node, link }) => {
      const visible = words === '' || matches(operation, words);
      show(node, visible);
      show(link, visible);
      return visible;
    });
    show(links, shown.length > 0);
    show(section, shown.length > 0);
    found += shown.length;
  }
  for (const id of ['reasons', 'schemas', 'about']) show(byId(id), words === '');
  show(byId('nothing'), found === 0);
}

/** Opens and shows what the address names: an operation, a reason, a schema. */
function follow() {
  const target = document.getElementById(decodeURIComponent(window.location.hash.slice(1)));
  if (!target) return;
  if (byId('search').value && target.closest('[hidden]')) {
    byId('search').value = '';
    byId('search').oninput();
  }
  if (target.tagName === 'DETAILS') target.open = true;
  target.scrollIntoView();
}

byId('token-form').addEventListener('submit', (event) => {
  event.preventDefault();
  token.value = byId('token').value.trim();
  byId('token').value = '';
  load();
});
window.addEventListener('hashchange', follow);
keepPrefix(ROOT);
load();
