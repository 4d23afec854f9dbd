// The scene's axes in the view's corner: three short lines that turn with the camera.

import { Vector3 } from '../vendor/three.bundle.min.js';
import { svg } from './dom.js';

const AXES = [['x', new Vector3(1, 0, 0)], ['y', new Vector3(0, 1, 0)], ['z', new Vector3(0, 0, 1)]];
const LENGTH = 24;

export class Gizmo {
  constructor(root) {
    this.axes = AXES.map(([name, axis]) => {
      const line = svg('line', { x1: 0, y1: 0, class: `axis axis-${name}` });
      const label = svg('text', { class: `axis-label axis-${name}`, 'text-anchor': 'middle', dy: '0.35em' });
      label.textContent = name;
      const group = svg('g', {}, line, label);
      root.append(group);
      return { axis, line, label, group };
    });
    this.root = root;
  }

  /** Turns the axes as the camera sees the scene's frame (`frame`: its rotation in the world). */
  turn(camera, frame) {
    const seen = this.axes.map((entry) => {
      const at = entry.axis.clone().applyQuaternion(frame).applyQuaternion(camera.quaternion.clone().invert());
      for (const [name, value] of [['x2', at.x], ['y2', -at.y]]) entry.line.setAttribute(name, (value * LENGTH).toFixed(2));
      entry.label.setAttribute('x', (at.x * (LENGTH + 8)).toFixed(2));
      entry.label.setAttribute('y', (-at.y * (LENGTH + 8)).toFixed(2));
      return { group: entry.group, depth: at.z };
    });
    seen.sort((a, b) => a.depth - b.depth).forEach(({ group }) => this.root.append(group)); // nearest last, on top
  }
}
