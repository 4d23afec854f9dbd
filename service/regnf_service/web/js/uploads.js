// From a file to a ready field: digest, the question whether the service has it, upload, import.

import { ApiProblem } from './api.js';
import { queueWords } from './documents.js';
import { number } from './format.js';
import { sha256Of } from './sha256.js';

const OF_NO_SIDE = /\.(glb|gltf|ply|obj|stl|pcd|xyz|pts|txt|las|laz)$/i; // files that do not say where free space is

/**
 * The document of the file's field once it is ready. role: what it will be used as, scene or object.
 * onStep(words, share) hears how far it is. Raises ApiProblem, also for a field that is refused.
 */
export function fieldOf(service, file, role, onStep) {
  return untilDone(async () => {
    onStep('Computing the digest', 0);
    const sha256 = await sha256Of(file, (share) => onStep('Computing the digest', share));
    let field = await service.field(sha256);
    if (!field || (field.state === 'rejected' && !field.kept_until)) {
      onStep('Uploading', 0);
      field = await service.upload(file, describe(file, role), (share, words) => onStep(`Uploading, ${words}`, share));
    }
    if (field.state === 'validating') field = await service.imported(sha256, (news) => onStep(importWords(news), null));
    if (!field || field.state === 'rejected') throw new ApiProblem(422, field?.error ?? { detail: 'The field was deleted.' });
    return named(service, field, labelOf(file.name));
  });
}

let underWay = 0;

/** Runs `work`; until it has ended the browser asks whoever leaves the page, for what it does would not be finished. */
export async function untilDone(work) {
  underWay += 1;
  if (underWay === 1) addEventListener('beforeunload', warn);
  try {
    return await work();
  } finally {
    underWay -= 1;
    if (underWay === 0) removeEventListener('beforeunload', warn);
  }
}

const warn = (event) => event.preventDefault();

export const importWords = (field) => (field.queue_position ? queueWords(field) : 'Reading the file');

/** A field that the service had under another name is called what it is called now. */
async function named(service, field, label) {
  if (!label || field.label === label) return field;
  return service.label(field.sha256, label).catch(() => field); // the name is a courtesy
}

/** What the service calls a file of this name. */
export const labelOf = (name) => name.replace(/[^\p{L}\p{N}\p{P}\p{S} ]/gu, '').slice(0, 200);

function describe(file, role) {
  const label = labelOf(file.name);
  return { ...(label && { label }), ...(OF_NO_SIDE.test(file.name) && { as: role }) };
}

/** What people call a field: by the library's name, else by its label, else by the one that its file carries. */
export const nameOf = (field) => field.library?.name || field.label || field.report?.label || `${field.report?.family ?? field.report?.layout ?? 'field'} ${field.sha256.slice(0, 8)}`;

/** Its size as "1.7 × 1.5 × 2.8": of the surface, where the import has measured it. */
export function sizeOf(bounds) {
  if (!bounds) return '';
  return bounds[1].map((high, i) => number(high - bounds[0][i], 3)).join(' × ');
}
