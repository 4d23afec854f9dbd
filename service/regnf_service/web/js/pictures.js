// Pictures that the service keeps of fields. Drawn on a canvas: an <img> could neither carry the token nor, under the
// page's policy, show fetched bytes.

import { el } from './dom.js';

/** A canvas with the PNG of a blob; label: what a screen reader says of it, empty for mere decoration. */
export async function canvasOf(blob, label) {
  const picture = await createImageBitmap(blob);
  const said = label ? { role: 'img', 'aria-label': label } : { 'aria-hidden': 'true' };
  const canvas = el('canvas', { width: picture.width, height: picture.height, ...said });
  canvas.getContext('2d').drawImage(picture, 0, 0);
  return canvas;
}
