// The few helpers through which the page touches its document. Text goes in as text, never as markup.

export const byId = (id) => document.getElementById(id);

/** A new element with properties and children; strings become text nodes. */
export function el(tag, properties = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith('data-') || name.startsWith('aria-') || name === 'role') node.setAttribute(name, value);
    else node[name] = value;
  }
  node.append(...children);
  return node;
}

/** The same for SVG, where everything is an attribute. */
export function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS('http://www.w3.org/2000/svg', tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

export function show(node, visible = true) {
  node.toggleAttribute('hidden', !visible); // SVG elements know the attribute alone, not the property
}

/** Fills a <dl> with [term, description] pairs; empty descriptions are left out. */
export function fillFacts(list, pairs) {
  const rows = pairs.filter(([, value]) => value !== null && value !== undefined && value !== '');
  list.replaceChildren(...rows.map(([term, value]) => el('div', {}, el('dt', {}, term), el('dd', {}, value))));
  show(list, rows.length > 0);
}

/** Puts the focus on the title of the tile at a place of a list, of the last one if there are fewer, or on the list. */
export function focusTile(list, place) {
  const tile = list.children[Math.min(place, list.children.length - 1)];
  (tile?.querySelector('h2') ?? list).focus();
}

/** Links between the pages stay below the prefix that this page was opened with. */
export function keepPrefix(root) {
  for (const link of document.querySelectorAll('[data-to]')) link.href = root + link.dataset.to;
}

/** Says something to screen readers without moving anything on the page. */
export function announce(text) {
  byId('announce').textContent = text;
}

/** Copies text and says so on the button; falls back to a selection where the clipboard is closed to the page. */
export async function copyText(text, button) {
  let copied = true;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    copied = copyBySelection(text);
  }
  const label = button.dataset.label ?? button.textContent;
  button.dataset.label = label;
  button.textContent = copied ? 'Copied' : 'Not allowed';
  announce(copied ? 'Copied' : 'The browser does not allow copying');
  setTimeout(() => { button.textContent = label; }, 1500);
}

// The clipboard API exists only in secure contexts; a service on a lab network is often plain HTTP.
function copyBySelection(text) {
  const area = el('textarea', { value: text, readOnly: true, className: 'unseen' });
  document.body.append(area);
  area.select();
  const copied = document.execCommand('copy');
  area.remove();
  return copied;
}
