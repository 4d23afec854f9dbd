// From a file to a ready field: digest, the question whether the service has it, upload, import.

import { ApiProblem } from './api.js';
import { sha256Of } from './sha256.js';

const OF_NO_SIDE = /\.(glb|gltf|ply|obj|stl|off|dae|pcd|xyz|pts|txt)$/i; // files that do not say where free space is

/**
 * The document of the file's field once it is ready. role: what it will be used as, scene or object.
 * onStep(words, share) hears how far it is. Raises ApiProblem, also for a field that is refused.
 */
export async function fieldOf(service, file, role, onStep) {
  onStep('Computing the digest', 0);
  const sha256 = await sha256Of(file, (share) => onStep('Computing the digest', share));
  let field = await service.field(sha256);
  if (!field || (field.state === 'rejected' && !field.kept_until)) {
    onStep('Uploading', 0);
    field = await service.upload(file, describe(file, role), (share, words) => onStep(`Uploading, ${words}`, share));
  }
  if (field.state === 'validating') {
    onStep('Reading the file', null);
    field = await service.imported(sha256);
  }
  if (!field || field.state === 'rejected') throw new ApiProblem(422, field?.error ?? { detail: 'The field was deleted.' });
  return field;
}

function describe(file, role) {
  const label = file.name.replace(/[^\p{L}\p{N}\p{P}\p{S} ]/gu, '').slice(0, 200);
  return { ...(label && { label }), ...(OF_NO_SIDE.test(file.name) && { as: role }) };
}

/** What people call a field: by the library's name, else by its label, else by the one that its file carries. */
export const nameOf = (field) => field.library?.name || field.label || field.report?.label || `${field.report?.family ?? 'field'} ${field.sha256.slice(0, 8)}`;
