// Pictures that the service keeps. Drawn on a canvas: an <img> could neither carry the token nor, under the page's policy,
// show fetched bytes.

import { el } from './dom.js';

/**
 * A canvas with the PNG of a blob; label: what a screen reader says of it, empty for mere decoration. panels: numbers of
 * those of its three square panels that are shown, without the captions above, which nobody can read in a small picture.
 */
export async function canvasOf(blob, label, panels = null) {
  const picture = await createImageBitmap(blob);
  const said = label ? { role: 'img', 'aria-label': label } : { 'aria-hidden': 'true' };
  const step = panels ? picture.width / 3 : picture.width;
  const caption = panels ? picture.height - step : 0;
  const rim = caption / 3; // captions reach a little into the panels
  const [width, height] = [step - 2 * rim, picture.height - caption - 2 * rim];
  const canvas = el('canvas', { width: width * (panels?.length ?? 1), height, ...said });
  const pencil = canvas.getContext('2d');
  (panels ?? [0]).forEach((panel, i) => pencil.drawImage(
    picture, panel * step + rim, caption + rim, width, height, i * width, 0, width, height,
  ));
  return canvas;
}

/** Two panels of a field's picture: of a scene its section, for walls hide what is in it; else two views. */
export const panelsOf = (role) => (role === 'scene' ? [0, 2] : [0, 1]);
