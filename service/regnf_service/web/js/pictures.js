// Pictures that the service keeps. Drawn on a canvas: an <img> could neither carry the token nor, under the page's policy,
// show fetched bytes.

import { el } from './dom.js';

/**
 * A canvas with the PNG of a blob; label: what a screen reader says of it, empty for mere decoration. panels: numbers of
 * those of its three square panels that are shown, without the captions above, which nobody can read in a small picture.
 */
export async function canvasOf(blob, label, panels = null) {
  const picture = await createImageBitmap(blob);
  const edge = panels ? picture.width / 3 : picture.width;
  const height = panels ? edge : picture.height;
  const said = label ? { role: 'img', 'aria-label': label } : { 'aria-hidden': 'true' };
  const canvas = el('canvas', { width: edge * (panels?.length ?? 1), height, ...said });
  const pencil = canvas.getContext('2d');
  const top = picture.height - height;
  (panels ?? [0]).forEach((panel, i) => pencil.drawImage(picture, panel * edge, top, edge, height, i * edge, 0, edge, height));
  return canvas;
}

/** Two panels of a field's picture: of a scene its section, for walls hide what is in it; else two views. */
export const panelsOf = (role) => (role === 'scene' ? [0, 2] : [0, 1]);
