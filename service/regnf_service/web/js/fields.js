// What the registered fields look like by themselves: the pictures that their imports left, where they did.

import { byId, el, show } from './dom.js';
import { canvasOf } from './pictures.js';

let asked = '';

/** Shows the scene's and the object's pictures; the object may be known only once a search has found it. */
export async function showFields(api, names, job, result) {
  const named = [['Scene', job.inputs?.scene], ['Object', result?.object ?? job.inputs?.object]];
  const fields = named.filter(([, sha256]) => /^[0-9a-f]{64}$/.test(sha256));
  const wanted = String(fields);
  if (wanted === asked) return;
  asked = wanted;
  const pictures = await Promise.all(fields.map(([name, sha256]) => figureOf(api, names, name, sha256)));
  if (wanted !== asked) return; // asked for others in the meantime
  byId('field-pictures').replaceChildren(...pictures.filter(Boolean));
  show(byId('fields'), pictures.some(Boolean));
}

async function figureOf(api, names, name, sha256) {
  try {
    const label = `${name}: the field's surface from two sides, and a section`;
    const canvas = await canvasOf(await api.fieldPicture(sha256), label);
    return el('figure', {}, canvas, el('figcaption', { className: 'note' }, `${name}: ${await names.of(sha256)}`));
  } catch {
    return null; // not every field has one
  }
}
