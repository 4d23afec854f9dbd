// Pictures that the service keeps. Drawn on a canvas: an <img> could neither carry the token nor, under the page's policy,
// show fetched bytes.

import { el } from './dom.js';

const PAPER = [225, 242]; // the least of a pixel's red, green and blue: from opaque to transparent

/**
 * A canvas with the PNG of a blob; label: what a screen reader says of it, empty for mere decoration. panels: numbers of
 * those of its square panels that are shown, without the captions above, which nobody can read in a small picture.
 * onPaper: whether it is drawn on white paper, which is left out, for a page may be dark.
 */
export async function canvasOf(blob, label, panels = null, onPaper = true) {
  const picture = await createImageBitmap(blob);
  const said = label ? { role: 'img', 'aria-label': label } : { 'aria-hidden': 'true' };
  const step = panels ? picture.width / Math.ceil(picture.width / picture.height) : picture.width;
  const caption = panels ? picture.height - step : 0;
  const rim = caption / 3; // captions reach a little into the panels
  const [width, height] = [step - 2 * rim, picture.height - caption - 2 * rim];
  const canvas = el('canvas', { width: width * (panels?.length ?? 1), height, ...said });
  const pencil = canvas.getContext('2d');
  (panels ?? [0]).forEach((panel, i) => pencil.drawImage(
    picture, panel * step + rim, caption + rim, width, height, i * width, 0, width, height,
  ));
  if (onPaper) clearPaper(pencil, canvas);
  return canvas;
}

function clearPaper(pencil, { width, height }) {
  const pixels = pencil.getImageData(0, 0, width, height);
  const { data } = pixels;
  const [opaque, clear] = PAPER;
  for (let i = 0; i < data.length; i += 4) {
    const least = Math.min(data[i], data[i + 1], data[i + 2]);
    data[i + 3] *= Math.min(1, Math.max(0, (clear - least) / (clear - opaque)));
  }
  pencil.putImageData(pixels, 0, 0);
}

/** Two panels of a field's picture: of a scene its section, for walls hide what is in it; else two views. */
export const panelsOf = (role) => (role === 'scene' ? [0, 2] : [0, 1]);
