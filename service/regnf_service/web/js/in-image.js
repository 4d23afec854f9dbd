// The card of a result in a recording: the overlay on the image of the detection, and where the object is in its camera's frame.

import { byId, el, fillFacts, show } from './dom.js';
import { fixed, number } from './format.js';
import { OVERLAY, overlayButton } from './overlay.js';

/** names: of the job's artifacts. */
export async function showInImage(api, { camera }, names) {
  if (!camera) return;
  const { frame, center_camera: center, object_unit_m: unit } = camera;
  byId('in-image-frame').textContent = frame;
  const mono = (text) => el('span', { className: 'mono' }, text);
  fillFacts(byId('in-image-facts'), [
    ['Center, m', center?.length ? mono(center.map((part) => fixed(part, 4)).join('  ')) : null],
    ['Distance, m', center?.length ? mono(fixed(Math.hypot(...center), 4)) : null],
    ['Unit of the object’s file', unit ? mono(`${number(unit)} m`) : 'unknown'],
  ]);
  show(byId('in-image'));
  if (!names.includes(OVERLAY)) return;
  try {
    byId('in-image-picture').replaceChildren(await overlayButton(api));
  } catch {
    byId('in-image-picture').textContent = 'The picture could not be made.';
  }
}
