// A result in the image of its detection: the object's outline there, and where it is as the camera sees it.

import { el } from './dom.js';
import { fixed } from './format.js';
import { canvasOf } from './pictures.js';

export const OVERLAY = 'overlay.png';
const CAPTION = 52; // pixels of the picture, with words that stand beside a small one anyway

/** Where the object is, as one line; '' for a result that no camera saw. */
export function placeWords({ camera }) {
  if (!camera?.center_camera?.length) return '';
  const [x, y, z] = camera.center_camera.map((part) => fixed(part, 3));
  return `Its center in the camera’s frame: x\u00a0${x}, y\u00a0${y}, z\u00a0${z}\u00a0m (right, down, forward)`;
}

/** The overlay, which opens large when it is clicked. Raises ApiProblem where the job has none. */
export async function overlayButton(api) {
  const blob = new Blob([await api.artifact(OVERLAY)]);
  const label = 'The object’s outline on the picture';
  const picture = await createImageBitmap(blob);
  const small = el('canvas', { width: picture.width, height: picture.height - CAPTION, role: 'img', 'aria-label': label });
  small.getContext('2d').drawImage(picture, 0, -CAPTION);
  return el('button', { type: 'button', className: 'overlay', title: 'Enlarge', onclick: () => open(blob, label) }, small);
}

async function open(blob, label) {
  const close = el('button', { type: 'button' }, 'Close');
  const dialog = el('dialog', { className: 'large', 'aria-label': label }, await canvasOf(blob, label, null, false), el('div', { className: 'row end' }, close));
  close.onclick = () => dialog.close();
  dialog.addEventListener('close', () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
