// The page's two small plots, as SVG: the distance over the iterations and the histogram of the residuals.

import { cssColor, rampColor } from './colors.js';
import { svg } from './dom.js';
import { number } from './format.js';

const MARGIN = { left: 46, right: 10, top: 10, bottom: 22 };
const HEIGHT = 150;

/** The mean distance between the surfaces. unit: what it is measured in. Clicking or dragging on it seeks: onSeek(index of the frame). */
export class DistancePlot {
  constructor(host, frames, unit, onSeek) {
    Object.assign(this, { host, unit });
    this.marks = frames.map((frame, index) => ({ index, distance: frame.distance, iteration: frame.iteration })).filter(({ distance }) => distance !== null);
    this.last = frames.length - 1;
    this.position = this.last;
    this.onSeek = onSeek;
    const distances = this.marks.map(({ distance }) => distance);
    [this.low, this.high] = [Math.min(...distances), Math.max(...distances)];
    this.logarithmic = this.low > 0 && this.high / this.low > 20;
    new ResizeObserver(() => this.draw()).observe(host);
    this.draw();
  }

  get useful() {
    return this.marks.length > 1;
  }

  /** What the plot shows, in words. */
  get summary() {
    const [first, last] = [this.marks[0], this.marks.at(-1)];
    return `Mean distance over ${this.marks.length} iterations, from ${number(first.distance, 3)} to ${number(last.distance, 3)} ${this.unit}`;
  }

  get note() {
    return this.logarithmic ? `${this.unit}, logarithmic` : this.unit;
  }

  /** Puts the cursor at a frame, fractions included. */
  moveTo(position) {
    this.position = position;
    this.placeCursor();
  }

  draw() {
    const width = this.host.clientWidth;
    if (!this.useful || !width) return;
    this.width = width;
    const points = this.marks.map(({ index, distance }) => `${this.x(index).toFixed(1)},${this.y(distance).toFixed(1)}`);
    const ground = HEIGHT - MARGIN.bottom;
    const area = `M${this.x(this.marks[0].index)},${ground}L${points.join('L')}L${this.x(this.marks.at(-1).index)},${ground}Z`;
    this.cursor = svg('g', { class: 'cursor' }, svg('line', { y1: MARGIN.top, y2: ground }), svg('circle', { r: 4 }));
    const root = svg(
      'svg', { viewBox: `0 0 ${width} ${HEIGHT}`, width, height: HEIGHT, role: 'img', 'aria-label': this.summary },
      ...this.grid(), svg('path', { class: 'area', d: area }),
      svg('polyline', { class: 'curve', points: points.join(' ') }), this.cursor,
    );
    root.addEventListener('pointerdown', (event) => this.seek(event));
    root.addEventListener('pointermove', (event) => { if (event.buttons === 1) this.seek(event); });
    this.host.replaceChildren(root);
    this.placeCursor();
  }

  grid() {
    const levels = this.logarithmic
      ? [this.low, Math.sqrt(this.low * this.high), this.high]
      : [this.low, (this.low + this.high) / 2, this.high];
    const rows = levels.flatMap((level) => [
      svg('line', { class: 'grid', x1: MARGIN.left, x2: this.width - MARGIN.right, y1: this.y(level), y2: this.y(level) }),
      svgText(number(level, 2), { x: MARGIN.left - 6, y: this.y(level), 'text-anchor': 'end', dy: '0.32em' }),
    ]);
    const ends = [[this.marks[0], 'start'], [this.marks.at(-1), 'end']];
    const labels = ends.map(([mark, anchor]) => svgText(
      `${anchor === 'start' ? 'iteration ' : ''}${mark.iteration}`,
      { x: this.x(mark.index), y: HEIGHT - 6, 'text-anchor': anchor },
    ));
    return [...rows, ...labels];
  }

  placeCursor() {
    if (!this.cursor) return;
    const at = Math.min(Math.max(this.position, this.marks[0].index), this.marks.at(-1).index);
    const before = this.marks.findLast(({ index }) => index <= at);
    const after = this.marks.find(({ index }) => index >= at);
    const share = after.index === before.index ? 0 : (at - before.index) / (after.index - before.index);
    const x = this.x(at);
    const y = (1 - share) * this.y(before.distance) + share * this.y(after.distance);
    const [line, dot] = this.cursor.children;
    line.setAttribute('x1', x);
    line.setAttribute('x2', x);
    dot.setAttribute('cx', x);
    dot.setAttribute('cy', y);
  }

  seek(event) {
    const box = this.host.getBoundingClientRect();
    const share = (event.clientX - box.left - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right);
    const [first, last] = [this.marks[0].index, this.marks.at(-1).index];
    this.onSeek(Math.round(Math.min(Math.max(first + share * (last - first), 0), this.last)));
  }

  x(index) {
    const [first, last] = [this.marks[0].index, this.marks.at(-1).index];
    return MARGIN.left + ((index - first) / Math.max(last - first, 1)) * (this.width - MARGIN.left - MARGIN.right);
  }

  y(distance) {
    const scale = this.logarithmic ? Math.log : (value) => value;
    const span = scale(this.high) - scale(this.low) || 1;
    return HEIGHT - MARGIN.bottom - ((scale(distance) - scale(this.low)) / span) * (HEIGHT - MARGIN.top - MARGIN.bottom);
  }
}

/** A histogram whose bars carry the ramp's colors, so that it is the legend as well. values >= 0. */
export function residualHistogram(values, top) {
  const [width, height, bins] = [200, 56, 25];
  const counts = new Array(bins).fill(0);
  for (const value of values) counts[Math.min(Math.floor((value / top) * bins), bins - 1)] += 1;
  const tallest = Math.max(...counts, 1);
  const step = width / bins;
  const bars = counts.map((count, bin) => {
    const tall = Math.max((count / tallest) * (height - 16), 1.5);
    const fill = cssColor(rampColor((bin + 0.5) / bins));
    return svg('rect', { x: bin * step + 0.5, y: height - 14 - tall, width: step - 1, height: tall, rx: 1, fill });
  });
  const label = `Histogram of ${values.length} residuals from 0 to ${number(top, 3)} and above`;
  return svg(
    'svg', { viewBox: `0 0 ${width} ${height}`, role: 'img', 'aria-label': label }, ...bars,
    svgText('0', { x: 0, y: height - 2, 'text-anchor': 'start' }),
    svgText(`≥ ${number(top, 2)}`, { x: width, y: height - 2, 'text-anchor': 'end' }),
  );
}

function svgText(text, attributes) {
  const node = svg('text', attributes);
  node.textContent = text;
  return node;
}
