// The handles of a box: buttons over the view that move, turn and size it, by pointer and by arrow keys.

import { Quaternion, Vector3 } from '../vendor/three.bundle.min.js';
import { el } from './dom.js';
import { alongLine, onPlane, rayAt } from './pick.js';
import { axesOf } from './samples.js';

const KEY_SHARE = 0.03; // of the box's size, for each press of an arrow key
const KEY_TURN = Math.PI / 36;
const SMALLEST = 0.01; // of the largest edge
const CLEAR = 1.5; // of a handle's width: how far from the box's middle handles stay

/** { x, y, z, w } as a list: the box's own turn about the up axis. */
export function quaternionOf({ yaw }, up) {
  const turn = [0, 0, 0, Math.cos(yaw / 2)];
  turn[axesOf(up).axis] = Math.sin(yaw / 2);
  return turn;
}

export class Handles {
  /** onChange(box) hears every change of the box that is edited. */
  constructor(host, viewer, onChange) {
    Object.assign(this, { host, viewer, onChange, box: null, up: 'z' });
    const names = ['Width, one side', 'Width, other side', 'Depth, one side', 'Depth, other side', 'Top', 'Bottom'];
    this.faces = names.map((name, i) => this.button('face', name, () => this.faceDrag(i), (step) => this.moveFace(i, step)));
    this.move = this.button('move', 'Move the box', () => this.moveDrag(), (step, across) => this.shift(step, across));
    this.turn = this.button('turn', 'Turn the box', () => this.turnDrag(), (step) => this.turnBy(Math.sign(step) * KEY_TURN));
    viewer.onDraw = () => this.place();
  }

  edit(box, up) {
    this.box = box;
    this.up = up;
    this.place();
  }

  button(kind, label, begin, press) {
    const node = el('button', { type: 'button', className: `handle ${kind}`, title: label, 'aria-label': label });
    node.addEventListener('pointerdown', (event) => {
      event.preventDefault();
      node.setPointerCapture(event.pointerId);
      this.drag = begin(event);
    });
    node.addEventListener('pointermove', (event) => { if (this.drag) this.drag(rayAt(event, this.viewer)); });
    for (const end of ['pointerup', 'pointercancel']) node.addEventListener(end, () => { this.drag = null; });
    node.addEventListener('keydown', (event) => {
      const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [-1, 1], ArrowUp: [1, 1] };
      if (!(event.key in arrows)) return;
      event.preventDefault();
      press(arrows[event.key][0] * KEY_SHARE, arrows[event.key][1]);
    });
    this.host.append(node);
    return node;
  }

  /** Unit directions of the box's own axes in the scene's frame: across, across, up. */
  axes() {
    const { axis, u, v } = axesOf(this.up);
    const turn = new Quaternion(...quaternionOf(this.box, this.up));
    return [u, v, axis].map((number) => ({ number, direction: new Vector3().setComponent(number, 1).applyQuaternion(turn).toArray() }));
  }

  /** [point, outward direction, number of the axis] of a face: 0 and 1 across, 2 and 3 across, 4 top, 5 bottom. */
  face(i) {
    const { number, direction } = this.axes()[i >> 1];
    const side = i % 2 ? -1 : 1;
    const half = (side * this.box.size[number]) / 2;
    return { number, outward: direction.map((part) => side * part), point: plus(this.box.center, direction, half) };
  }

  faceDrag(i) {
    const { number, outward, point } = this.face(i);
    const [size, center] = [[...this.box.size], this.box.center];
    const opposite = plus(point, outward, -size[number]);
    let grip = null; // how far outside the face it was taken
    return (ray) => {
      const far = alongLine(ray, opposite, outward);
      if (far === null) return;
      grip ??= far - size[number];
      const edge = Math.max(far - grip, SMALLEST * Math.max(...size));
      this.change({ size: size.with(number, edge), center: plus(center, outward, (edge - size[number]) / 2) });
    };
  }

  moveFace(i, share) {
    const { number, outward } = this.face(i);
    const { size, center } = this.box;
    const step = share * size[number];
    this.change({ size: size.with(number, size[number] + step), center: plus(center, outward, step / 2) });
  }

  moveDrag() {
    const { center } = this.box;
    const up = this.axes()[2].direction;
    let grip = null;
    return (ray) => {
      const at = onPlane(ray, center, up);
      if (!at) return;
      grip ??= at;
      this.change({ center: center.map((part, k) => part + at[k] - grip[k]) });
    };
  }

  shift(share, across) {
    const { number, direction } = this.axes()[across];
    this.change({ center: plus(this.box.center, direction, share * this.box.size[number]) });
  }

  turnDrag() {
    const { center, yaw } = this.box;
    const { u, v } = axesOf(this.up);
    const up = this.axes()[2].direction;
    let first = null;
    return (ray) => {
      const at = onPlane(ray, center, up);
      if (!at) return;
      const angle = Math.atan2(at[v] - center[v], at[u] - center[u]);
      first ??= angle;
      this.change({ yaw: yaw + angle - first });
    };
  }

  turnBy(angle) {
    this.change({ yaw: this.box.yaw + angle });
  }

  change(part) {
    this.box = { ...this.box, ...part };
    this.onChange(this.box);
    this.place();
  }

  /** Puts the buttons where the box is on the screen. */
  place() {
    const all = [...this.faces, this.move, this.turn];
    for (const node of all) node.toggleAttribute('hidden', !this.box);
    if (!this.box) return;
    const middle = this.onScreen(this.box.center);
    const [aside, , up] = this.axes();
    const foot = plus(this.box.center, up.direction, -0.5 * this.box.size[up.number]);
    const corner = plus(foot, aside.direction, 0.75 * this.box.size[aside.number]);
    const below = { ...middle, y: Math.max(this.onScreen(foot).y, middle.y) + 1 };
    const wanted = [...this.faces.map((_, i) => this.onScreen(this.face(i).point)), below, this.onScreen(corner)];
    spread(middle, wanted, this.move.offsetWidth).forEach((at, i) => this.put(all[i], at));
  }

  /** Where a point of the scene is drawn: { x, y } in pixels, and whether it is before the camera. */
  onScreen(point) {
    const { camera, frame, renderer } = this.viewer;
    const at = frame.localToWorld(new Vector3(...point)).project(camera);
    const { clientWidth, clientHeight } = renderer.domElement;
    return { x: ((at.x + 1) / 2) * clientWidth, y: ((1 - at.y) / 2) * clientHeight, seen: at.z <= 1 };
  }

  put(node, { x, y, seen }) {
    node.style.transform = `translate(${x}px, ${y}px) translate(-50%, -50%)`;
    node.toggleAttribute('hidden', !seen);
  }
}

/**
 * Places on the screen, moved away from `middle` so that what is there can be seen and clicked, and farther until each has
 * room: none is nearer than `width` to the ones before. A direction that points at the reader has no place.
 */
function spread(middle, places, width) {
  const placed = [];
  for (const at of places) {
    const [x, y] = [at.x - middle.x, at.y - middle.y];
    const far = Math.hypot(x, y);
    const moved = (to) => ({ x: middle.x + (x / far) * to, y: middle.y + (y / far) * to, seen: at.seen });
    let to = Math.max(far, CLEAR * width);
    const isTaken = () => placed.some((one) => one.seen && Math.hypot(one.x - moved(to).x, one.y - moved(to).y) < width);
    while (far > 0 && isTaken()) to += width / 4;
    placed.push(far > 0 ? moved(to) : { ...at, seen: false });
  }
  return placed;
}

const plus = (point, direction, far) => point.map((part, i) => part + far * direction[i]);
