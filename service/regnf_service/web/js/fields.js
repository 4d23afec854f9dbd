// What the registered fields look like by themselves: the pictures that their imports left, where they did.

import { byId, el, show } from './dom.js';

let asked = '';

/** Shows the scene's and the object's pictures; the object may be known only once a search has found it. */
export async function showFields(api, job, result) {
  const named = [['Scene', job.inputs?.scene], ['Object', result?.object ?? job.inputs?.object]];
  const fields = named.filter(([, sha256]) => /^[0-9a-f]{64}$/.test(sha256));
  const wanted = String(fields);
  if (wanted === asked) return;
  asked = wanted;
  const pictures = await Promise.all(fields.map(([name, sha256]) => figureOf(api, name, sha256)));
  if (wanted !== asked) return; // asked for others in the meantime
  byId('field-pictures').replaceChildren(...pictures.filter(Boolean));
  show(byId('fields'), pictures.some(Boolean));
}

// Drawn on a canvas: an <img> could neither carry the token nor, under the page's policy, show fetched bytes.
async function figureOf(api, name, sha256) {
  try {
    const picture = await createImageBitmap(await api.fieldPicture(sha256));
    const label = `${name}: the field's surface from two sides, and a section`;
    const canvas = el('canvas', { width: picture.width, height: picture.height, role: 'img', 'aria-label': label });
    canvas.getContext('2d').drawImage(picture, 0, 0);
    return el('figure', {}, canvas, el('figcaption', { className: 'note' }, name));
  } catch {
    return null; // not every field has one
  }
}
