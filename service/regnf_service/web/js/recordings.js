// Recordings on the service: how they are sent, what their documents say, the pictures of their frames.

import { ApiProblem } from './api.js';
import { archiveOf } from './archive.js';
import { sha256Of } from './sha256.js';
import { importWords, labelOf, untilDone } from './uploads.js';

/** Whether a document, of a recording or of a field, is of a recording. */
export const isRecording = ({ description }) => description?.as === 'recording';

/** The names of a recording's frames. */
export const framesOf = ({ report }) => report?.frames ?? ['0'];

/** The document of a recording in a file, ready; onStep(words, share) hears how far it is. Raises ApiProblem. */
export function recordingOfFile(service, file, onStep) {
  return untilDone(async () => {
    onStep('Computing the digest', 0);
    const sha256 = await sha256Of(file, (share) => onStep('Computing the digest', share));
    const known = await service.field(sha256);
    const usable = known && known.state !== 'rejected';
    const headers = { 'Content-Type': 'application/octet-stream' };
    return imported(service, usable ? known : await sent(service, file.name, file, headers, onStep), onStep);
  });
}

/** The same of one frame. parts: its depth, color and camera, as files; settings in place of a camera that is no JSON. */
export function recordingOfFrame(service, parts, onStep) {
  if (!parts.camera) return recordingOfFile(service, archiveOf(parts.depth.name, filesOf(parts)), onStep);
  return untilDone(async () => {
    const form = new FormData();
    for (const name of ['depth', 'color', 'camera']) if (parts[name]) form.append(name, parts[name]);
    return imported(service, await sent(service, parts.depth.name, form, {}, onStep), onStep);
  });
}

/** A frame's files as a folder has them. */
function filesOf({ depth, color, settings }) {
  const ending = settings.name.split('.').pop();
  return [[depth.name, depth], [color?.name, color], [`camera.${ending}`, settings]]
    .filter(([, file]) => file).map(([path, file]) => ({ path, file }));
}

/** The picture of a frame, a PNG of the image that detections are made in. */
export async function framePicture(service, sha256, name) {
  const path = name.split('/').map(encodeURIComponent).join('/');
  return (await service.request(`/recordings/${sha256}/frames/${path}/color.png`, { cache: 'default' })).blob();
}

function sent(service, name, body, headers, onStep) {
  onStep('Uploading', 0);
  const label = labelOf(name);
  const path = `/recordings${label ? `?label=${encodeURIComponent(label)}` : ''}`;
  return service.send(path, body, headers, (share, words) => onStep(`Uploading, ${words}`, share));
}

async function imported(service, { sha256 }, onStep) {
  const known = await service.imported(sha256, (news) => onStep(importWords(news), null));
  if (known?.state === 'ready') return known;
  throw new ApiProblem(422, known?.error ?? { detail: 'The recording was deleted.' });
}
