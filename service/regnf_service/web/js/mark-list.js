// What is marked in the pictures of a recording: points and boxes in pixels, and masks. Each becomes a job.

import { announce, byId, el, show } from './dom.js';

const FIRST = 'Click the object in the picture, or draw a box around it.';
const ONE_MORE = 'A click or a box elsewhere moves the mark there. Add a mark keeps this mark and starts another.';

export class MarkList {
  /** view() is the picture that they are drawn in; onChange() hears that there are others. */
  constructor(view, onChange) {
    Object.assign(this, { view, onChange, boxes: [], edits: null, adding: false, made: 0, title: 'Marks', one: 'Add a mark', wanted: 'a mark: click an object in the picture' });
  }

  /** What was marked: a thing more, or another place of the one that is edited. */
  take(shape, mark = null) {
    const known = mark && this.boxes.find(({ id }) => id === mark.id);
    const current = known ?? this.current() ?? (this.adding ? null : this.boxes.at(-1));
    const entry = current ?? this.make();
    entry.shape = shape;
    this.adding = false;
    this.show(entry.id);
    announce(wordsOf(entry));
  }

  /** The next click makes a mark more. */
  add() {
    this.adding = true;
    this.rest();
    byId('boxes-note').textContent = 'Click the next object, or draw a box around it.';
  }

  rest() {
    this.edits = null;
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

  /** Shows a mark in its frame, to be changed. */
  async choose({ id, shape }) {
    if (shape.frame !== this.view().frame) await this.view().choose(shape.frame);
    this.show(id);
  }

  remove(id) {
    this.view().removeMark(id);
    this.boxes = this.boxes.filter((entry) => entry.id !== id);
    this.show(this.edits === id ? null : this.edits);
  }

  clear() {
    this.adding = false;
    for (const { id } of [...this.boxes]) this.remove(id);
  }

  draw() {
    for (const entry of this.boxes) this.view().showMark(entry, entry.id === this.edits);
    byId('boxes').replaceChildren(...this.boxes.map((entry) => el('li', {},
      el('button', { type: 'button', 'aria-pressed': String(entry.id === this.edits), onclick: () => this.choose(entry) }, this.rowWords(entry)),
      el('button', { type: 'button', className: 'quiet', 'aria-label': `Remove mark ${entry.id}`, onclick: () => this.remove(entry.id) }, 'Remove'))));
    byId('boxes-note').textContent = this.boxes.length ? ONE_MORE : FIRST;
    show(byId('numbers'), false);
  }

  rowWords(entry) {
    return wordsOf(entry) + (this.view().hasSeveral ? ` in ${entry.shape.frame}` : '');
  }

  nameOf({ id }) {
    return `Mark ${id}`;
  }

  /** The entry as a request says it. */
  detectionOf({ shape: { frame, point, box, mask } }) {
    const round = (values) => values.map((part) => Math.round(part * 10) / 10);
    if (mask) return { frame, mask };
    return point ? { frame, point_2d: round(point) } : { frame, box_2d: round(box) };
  }
}

const wordsOf = ({ id, shape }) => `Mark ${id}: ${shapeWords(shape)}`;

function shapeWords({ point, box }) {
  if (point) return `pixel ${point.map(Math.round).join(', ')}`;
  return box ? `box of ${Math.round(box[2] - box[0])} × ${Math.round(box[3] - box[1])} pixels` : 'a mask';
}
