// The boxes in the scene: which there are, which one is edited, and its numbers.

import { announce, byId, el, show } from './dom.js';
import { number } from './format.js';

const ROWS = [['Center', 'center'], ['Size', 'size']];
const FIRST = 'Click an object in the scene to get a box around it. Click it again for a larger or smaller box.';
const ONE_MORE = 'Click the object again for a larger or smaller box. A click elsewhere moves the box there. Add a box keeps this box and starts another.';

export class BoxList {
  /** workspace() is where they are drawn; onChange() hears that there are others. */
  constructor(workspace, onChange) {
    Object.assign(this, { workspace, onChange, boxes: [], edits: null, adding: false, made: 0, title: 'Boxes', one: 'Add a box', wanted: 'a box: click an object in the scene' });
    this.inputs = this.makeInputs();
  }

  /** A thing was clicked: it gets a box. The same thing again: the next of the boxes that may be meant. */
  click(point) {
    const current = this.current() ?? (this.adding ? null : this.boxes.at(-1));
    const again = current && !this.adding && holds(current.box, point);
    const proposals = again && current.proposals ? current.proposals : this.workspace().propose(point);
    const at = again ? (current.at + 1) % proposals.length : 0;
    const entry = this.adding || !current ? this.make() : current;
    Object.assign(entry, { box: proposals[at], proposals, at });
    this.adding = false;
    this.show(entry.id);
    announce(`Box ${entry.id}: ${sizeOf(entry.box)}`);
  }

  /** A handle has changed the box. */
  edited(box) {
    Object.assign(this.current(), { box, proposals: null });
    this.show(this.edits);
  }

  /** The next click makes a box more. */
  add() {
    this.adding = true;
    this.rest();
    byId('boxes-note').textContent = 'Click the next object to get a box around it.';
  }

  /** Leaves the view to what was found: no box is edited. */
  rest() {
    this.edits = null;
    this.workspace().handles.edit(null, this.workspace().up);
    this.draw();
  }

  make() {
    this.made += 1;
    this.boxes.push({ id: this.made });
    return this.boxes.at(-1);
  }

  current() {
    return this.boxes.find(({ id }) => id === this.edits) ?? null;
  }

  show(id) {
    this.edits = id;
    this.draw();
    this.onChange();
  }

  remove(id) {
    this.workspace().removeBox(id);
    this.boxes = this.boxes.filter((entry) => entry.id !== id);
    if (this.edits === id) {
      this.edits = null;
      this.workspace().handles.edit(null, this.workspace().up);
    }
    this.show(this.edits);
  }

  clear() {
    this.adding = false;
    for (const { id } of [...this.boxes]) this.remove(id);
  }

  draw() {
    for (const { id, box } of this.boxes) this.workspace().showBox(id, box, id === this.edits);
    byId('boxes').replaceChildren(...this.boxes.map(({ id, box }) => el('li', {},
      el('button', { type: 'button', 'aria-pressed': String(id === this.edits), onclick: () => this.show(id) }, `Box ${id}: ${sizeOf(box)}`),
      el('button', { type: 'button', className: 'quiet', 'aria-label': `Remove box ${id}`, onclick: () => this.remove(id) }, 'Remove'))));
    byId('boxes-note').textContent = this.boxes.length ? ONE_MORE : FIRST;
    show(byId('numbers'), Boolean(this.current()));
    this.fill();
  }

  nameOf({ id }) {
    return `Box ${id}`;
  }

  /** The entry as a request says it. */
  detectionOf({ box }) {
    return this.workspace().detectionOf(box);
  }

  makeInputs() {
    const inputs = { center: [], size: [], yaw: [] };
    const input = (name, i, label) => {
      const node = el('input', { type: 'number', step: 'any', 'aria-label': label, onchange: () => this.typed(name, i, node.valueAsNumber) });
      inputs[name].push(node);
      return node;
    };
    const rows = ROWS.flatMap(([label, name]) => [el('span', { className: 'note' }, label), ...['x', 'y', 'z'].map((axis, i) => input(name, i, `${label} ${axis}`))]);
    byId('box-numbers').append(...rows, el('span', { className: 'note' }, 'Turn, °'), input('yaw', 0, 'Turn about the up axis, degrees'));
    return inputs;
  }

  typed(name, i, value) {
    if (!Number.isFinite(value) || (name === 'size' && value <= 0)) return this.fill();
    const { box } = this.current();
    const change = name === 'yaw' ? (value * Math.PI) / 180 : box[name].with(i, value);
    return this.edited({ ...box, [name]: change });
  }

  fill() {
    const box = this.current()?.box;
    if (!box) return;
    for (const [, name] of ROWS) this.inputs[name].forEach((node, i) => { node.value = String(Number(box[name][i].toPrecision(5))); });
    this.inputs.yaw[0].value = String(Math.round((box.yaw * 1800) / Math.PI) / 10);
  }
}

const sizeOf = (box) => box.size.map((edge) => number(edge, 3)).join(' × ');

function holds({ center, size }, point) {
  const reach = Math.hypot(...size) / 2;
  return Math.hypot(...center.map((part, i) => part - point[i])) < reach;
}
