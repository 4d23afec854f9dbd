// The handles of a mark in a picture: buttons that move a point, or move and size a box, by pointer and by arrow keys.

import { el, show } from './dom.js';

const KEY_STEP = 1; // pixels of the picture; with Shift ten
const LEAST = 2; // pixels of the picture: a box's least edge
const NAMES = {
  point: [['move', 'Move the point', [0, 1]]],
  box: [
    ['move', 'Move the box', [0, 1, 2, 3]], ['face', 'Left top corner', [0, 1]], ['face', 'Right top corner', [2, 1]],
    ['face', 'Left bottom corner', [0, 3]], ['face', 'Right bottom corner', [2, 3]],
  ],
}; // what each handle moves: places in [u, v] or [left, top, right, bottom]

export class MarkHandles {
  /** view: the picture, with size, pixelAt(event) and onShape(shape, mark). */
  constructor(host, view) {
    Object.assign(this, { host, view, mark: null, kind: null, nodes: [] });
  }

  /** Puts the handles at a mark; null: there are none. */
  edit(mark) {
    this.mark = mark;
    const kind = mark && ['point', 'box'].find((name) => mark.shape[name]);
    if (kind !== this.kind) this.nodes = (NAMES[kind] ?? []).map((each) => this.button(...each));
    if (kind !== this.kind) this.host.replaceChildren(...this.nodes);
    this.kind = kind;
    show(this.host, Boolean(kind));
    if (!kind) return;
    const [width, height] = this.view.size;
    this.nodes.forEach((node, i) => {
      const [u, v] = placeOf(mark.shape[kind], NAMES[kind][i][2]);
      Object.assign(node.style, { left: `${(100 * u) / width}%`, top: `${(100 * v) / height}%` });
    });
  }

  button(look, label, places) {
    const node = el('button', { type: 'button', className: `handle ${look}`, title: label, 'aria-label': label });
    let grip = null; // { at, values }: where it was taken, and what it moved then
    node.addEventListener('pointerdown', (event) => {
      node.setPointerCapture(event.pointerId);
      grip = { at: this.view.pixelAt(event), values: this.mark.shape[this.kind] };
    });
    node.addEventListener('pointermove', (event) => {
      if (!grip) return;
      const at = this.view.pixelAt(event);
      this.change(grip.values, places, at.map((part, i) => part - grip.at[i]));
    });
    for (const end of ['pointerup', 'pointercancel']) node.addEventListener(end, () => { grip = null; });
    node.addEventListener('keydown', (event) => {
      const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      if (!(event.key in arrows)) return;
      event.preventDefault();
      const step = KEY_STEP * (event.shiftKey ? 10 : 1);
      this.change(this.mark.shape[this.kind], places, arrows[event.key].map((part) => part * step));
    });
    return node;
  }

  change(values, places, by) {
    const changed = moved(values, places, by, this.view.size);
    this.view.onShape({ frame: this.mark.shape.frame, [this.kind]: changed }, this.mark);
  }
}

/** Where a handle that moves these places of a point or a box is: in the middle of what it moves. */
function placeOf(values, places) {
  return [0, 1].map((axis) => {
    const own = places.filter((place) => place % 2 === axis).map((place) => values[place]);
    return own.reduce((sum, part) => sum + part, 0) / own.length;
  });
}

/** The point or box with these places moved: as a whole within the picture, and corners not past one another. */
export function moved(values, places, by, size) {
  const next = [...values];
  for (const axis of [0, 1]) {
    const own = places.filter((place) => place % 2 === axis);
    const [low, high] = [Math.min(...own.map((place) => values[place])), Math.max(...own.map((place) => values[place]))];
    const step = Math.min(Math.max(by[axis], -low), size[axis] - high);
    for (const place of own) next[place] += step;
    if (values.length === 4 && own.length === 1) {
      const [place] = own;
      const other = values[(place + 2) % 4];
      next[place] = place < 2 ? Math.min(next[place], other - LEAST) : Math.max(next[place], other + LEAST);
    }
  }
  return next;
}
