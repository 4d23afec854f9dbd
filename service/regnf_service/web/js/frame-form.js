// One frame of a depth camera, put together from files that come at once or one by one; what no file says is typed.

import { byId, show } from './dom.js';
import { sizeOf } from './frame-files.js';

const PARTS = ['depth', 'color', 'camera', 'mask', 'settings'];
const FOCAL = 0.95; // of the width: about what depth cameras have, shown as an example only

export class FrameForm {
  /**
   * onFrame(parts) hears of a frame that is complete: depth, camera or settings and, where
   * they are given, color and mask.
   */
  constructor(onFrame) {
    Object.assign(this, { onFrame, parts: {}, size: null });
    byId('camera-form').addEventListener('submit', (event) => {
      event.preventDefault();
      this.parts.camera = new Blob([JSON.stringify(this.typed())], { type: 'application/json' });
      this.onFrame(this.parts);
    });
  }

  /** Whether files hold a part of a frame; a text alone is one only of a frame that has begun. */
  isPart(found) {
    return PARTS.some((name) => found[name] && (name !== 'settings' || found.depth || this.parts.depth));
  }

  /** Takes what was chosen or dropped, beside what came before; a depth image begins another frame. */
  async take(found) {
    const given = Object.fromEntries(PARTS.filter((name) => found[name]).map((name) => [name, found[name]]));
    this.parts = given.depth ? given : { ...this.parts, ...given };
    const { depth, camera, settings } = this.parts;
    if (!depth) {
      this.say('The depth image of the frame is missing: a PNG of 16 bits, a TIFF or a .npy file. Add it.');
    } else if (camera || settings) {
      this.onFrame(this.parts);
    } else {
      await this.ask();
    }
  }

  /** Asks for the intrinsics; no number is taken that nobody has given, except the middle of the image. */
  async ask() {
    this.size = await sizeOf(this.parts.depth);
    const [width, height] = this.size ?? [640, 480];
    const examples = { fx: FOCAL * width, fy: 'as fx', cx: (width - 1) / 2, cy: (height - 1) / 2 };
    for (const [name, example] of Object.entries(examples)) byId(`camera-${name}`).placeholder = String(example);
    byId('camera-unit').disabled = /\.npy$/i.test(this.parts.depth.name);
    this.say(`${this.parts.depth.name}: no file has the camera's intrinsics. Enter them under Scene, or add a camera.json.`);
    show(byId('camera-form'));
    byId('camera-fx').focus();
  }

  typed() {
    const [width, height] = this.size ?? [];
    const read = (name) => byId(`camera-${name}`).valueAsNumber;
    const or = (value, usual) => (Number.isFinite(value) ? value : usual);
    const fx = read('fx');
    const camera = { fx, fy: or(read('fy'), fx), cx: or(read('cx'), (width - 1) / 2), cy: or(read('cy'), (height - 1) / 2) };
    const unit = byId('camera-unit').disabled ? {} : { depth_unit: Number(byId('camera-unit').value) };
    return { ...camera, ...(this.size && { width, height }), ...unit };
  }

  say(text) {
    for (const id of ['scene-state', 'welcome-state']) byId(id).textContent = text;
  }

  /** The frame is on the service: nothing is asked any more. */
  done() {
    show(byId('camera-form'), false);
  }
}
