// The pictures of a recording's frames: one large, in which things are marked by mouse, finger and keys, and a strip of all.

import { told } from './api.js';
import { announce, byId, el, show, svg } from './dom.js';
import { Turns } from './latest.js';
import { MarkHandles } from './mark-handles.js';
import { framePicture, framesOf } from './recordings.js';

const DRAG_PIXELS = 5; // of the screen: less is a click
const LEAST = 2; // pixels of the picture: a box's least edge
const KEY_SHARE = 0.01; // of the picture's longer side, for each press of an arrow key; with Shift five times as far
const BOX_SHARE = 0.1; // half of the box that the key B makes
const THUMB = 96;

export class PictureView {
  /**
   * onShape(shape, mark) hears what was marked: { frame, point } or { frame, box }, in pixels of the frame's picture; mark: the
   * one that was changed, null for a click or a drawn box.
   */
  constructor(onShape) {
    Object.assign(this, { onShape, up: null, frame: null, image: null, size: [1, 1], cursor: null, marks: new Map(), turns: new Turns(), pictures: new Map() });
    this.sheet = byId('sheet');
    this.pencil = byId('frame').getContext('2d');
    this.handles = new MarkHandles(byId('mark-handles'), this);
    this.nearby = new IntersectionObserver((entries) => entries.filter((one) => one.isIntersecting).forEach((one) => this.fill(one.target)));
    this.listen();
  }

  /** Shows the recording's first frame, and the strip where there are several. */
  async open(service, recording) {
    Object.assign(this, { service, recording, hasSeveral: framesOf(recording).length > 1 });
    this.clear();
    this.nearby.disconnect();
    const names = framesOf(recording);
    byId('strip').replaceChildren(...names.map((name) => this.thumb(name)));
    show(byId('strip'), this.hasSeveral);
    await this.choose(names[0]);
  }

  clear() {
    this.turns.next();
    Object.assign(this, { frame: null, image: null, cursor: null });
    this.pictures.clear();
    this.marks.clear();
    this.draw();
  }

  /** Shows a frame of the recording; the latest choice counts. */
  async choose(name) {
    const isLatest = this.turns.next();
    for (const node of byId('strip').children) node.setAttribute('aria-pressed', String(node.dataset.frame === name));
    try {
      const picture = await this.picture(name);
      if (!isLatest()) return;
      this.size = [picture.width, picture.height];
      this.sheet.style.setProperty('--ratio', picture.width / picture.height);
      Object.assign(byId('frame'), { width: picture.width, height: picture.height });
      byId('marks').setAttribute('viewBox', `0 0 ${picture.width} ${picture.height}`);
      this.sheet.setAttribute('aria-label', `The picture of frame ${name}`);
      byId('picture-note').textContent = '';
      Object.assign(this, { frame: name, image: picture, cursor: null });
    } catch (error) {
      if (isLatest()) byId('picture-note').textContent = `${name}: ${told(error)}`;
    }
    this.draw();
  }

  /** A picture is asked for once. */
  picture(name) {
    if (!this.pictures.has(name)) {
      const asked = framePicture(this.service, this.recording.sha256, name).then(createImageBitmap);
      asked.catch(() => this.pictures.delete(name));
      if (this.pictures.size > 8) this.pictures.delete(this.pictures.keys().next().value);
      this.pictures.set(name, asked);
    }
    return this.pictures.get(name);
  }

  thumb(name) {
    const canvas = el('canvas', { width: THUMB, height: 0.75 * THUMB, 'aria-hidden': 'true' });
    const node = el('button', { type: 'button', title: name, 'data-frame': name, 'aria-pressed': 'false', 'aria-label': `Frame ${name}` }, canvas);
    node.onclick = () => this.choose(name);
    this.nearby.observe(node);
    return node;
  }

  /** Draws the picture of a frame whose place in the strip is seen. */
  async fill(node) {
    this.nearby.unobserve(node);
    const { service, recording } = this;
    try {
      const blob = await framePicture(service, recording.sha256, node.dataset.frame);
      const small = await createImageBitmap(blob, { resizeWidth: THUMB, resizeQuality: 'medium' });
      const [canvas] = node.children;
      canvas.height = small.height;
      canvas.getContext('2d').drawImage(small, 0, 0);
    } catch {
      node.append(node.dataset.frame); // its name must do
    }
  }

  /** Draws a mark; the one that is edited gets the handles. mark: { id, shape }. */
  showMark(mark, edited) {
    this.marks.set(mark.id, { ...mark, edited });
    this.draw();
  }

  removeMark(id) {
    this.marks.delete(id);
    this.draw();
  }

  draw() {
    const shown = [...this.marks.values()].filter(({ shape }) => shape.frame === this.frame);
    const pixel = this.size[0] / (this.sheet.clientWidth || this.size[0]);
    const nodes = shown.flatMap(({ shape, edited }) => drawn(shape, pixel, edited ? 'mark edited' : 'mark'));
    if (this.cursor) nodes.push(...cross(this.cursor, 14 * pixel, 'cursor'));
    byId('marks').replaceChildren(...nodes);
    const tints = shown.map(({ shape }) => shape.tint).filter(Boolean);
    if (this.image) for (const one of [this.image, ...tints]) this.pencil.drawImage(one, 0, 0, ...this.size);
    this.handles.edit(shown.find(({ edited }) => edited) ?? null);
  }

  /** The pixel of the picture under the pointer, fractions included, within the picture. */
  pixelAt({ clientX, clientY }) {
    const { left, top, width, height } = this.sheet.getBoundingClientRect();
    return this.within([((clientX - left) / width) * this.size[0], ((clientY - top) / height) * this.size[1]]);
  }

  within(point) {
    return point.map((part, i) => Math.min(Math.max(part, 0), this.size[i]));
  }

  listen() {
    let began = null;
    const boxTo = (event) => boxBetween(this.pixelAt(began), this.pixelAt(event));
    const isDrag = (event) => Math.hypot(event.clientX - began.clientX, event.clientY - began.clientY) > DRAG_PIXELS;
    this.sheet.addEventListener('pointerdown', (event) => {
      if (!this.frame || event.button !== 0 || event.target.closest('.handle')) return;
      began = event;
      this.sheet.setPointerCapture(event.pointerId);
    });
    this.sheet.addEventListener('pointermove', (event) => {
      if (!began || !isDrag(event)) return;
      this.draw();
      byId('marks').append(...drawn({ box: boxTo(event) }, 1, 'mark edited'));
    });
    this.sheet.addEventListener('pointercancel', () => {
      began = null;
      this.draw();
    });
    this.sheet.addEventListener('pointerup', (event) => {
      if (!began) return;
      this.cursor = null;
      if (isDrag(event)) this.mark({ box: boxTo(event) });
      else this.mark({ point: this.pixelAt(event) });
      began = null;
    });
    this.sheet.addEventListener('keydown', (event) => { if (event.target === this.sheet && this.frame) this.key(event); });
    this.sheet.addEventListener('blur', () => {
      this.cursor = null;
      this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.sheet);
  }

  mark(shape) {
    const { box } = shape;
    if (box && Math.min(box[2] - box[0], box[3] - box[1]) < LEAST) return this.draw();
    return this.onShape({ frame: this.frame, ...shape }, null);
  }

  /** Arrow keys move a cross over the picture, Enter marks the pixel there, B a box round it. */
  key(event) {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const at = this.cursor ?? this.size.map((edge) => edge / 2);
    const longer = Math.max(...this.size);
    if (event.key in arrows) {
      const step = longer * KEY_SHARE * (event.shiftKey ? 5 : 1);
      this.cursor = this.within(at.map((part, i) => Math.round(part + arrows[event.key][i] * step)));
      announce(`Pixel ${this.cursor.join(', ')}`);
    } else if (event.key === 'Enter') {
      this.mark({ point: at });
    } else if (event.key.toLowerCase() === 'b' && !event.ctrlKey && !event.metaKey && !event.altKey) {
      const reach = BOX_SHARE * longer;
      this.mark({ box: boxBetween(this.within(at.map((part) => part - reach)), this.within(at.map((part) => part + reach))) });
    } else return;
    event.preventDefault();
    this.draw();
  }
}

const boxBetween = ([u, v], [x, y]) => [Math.min(u, x), Math.min(v, y), Math.max(u, x), Math.max(v, y)];

/** A shape in SVG, twice: a dark rim below, so that it shows on every picture. pixel: of the picture, for one of the screen. */
function drawn({ point, box }, pixel, name) {
  if (!point && !box) return []; // a mask is drawn on the picture itself
  if (point) return cross(point, 18 * pixel, name);
  const [x, y, right, bottom] = box;
  return ['rim', name].map((kind) => svg('rect', { x, y, width: right - x, height: bottom - y, class: kind }));
}

function cross([x, y], reach, name) {
  const path = `M${x - reach} ${y}h${2 * reach}M${x} ${y - reach}v${2 * reach}`;
  return ['rim', name].map((kind) => svg('path', { d: path, class: kind }));
}
