// The object in the scene, where the registration found it: rendered before and after, once somebody asks for it.

import { ApiProblem, told } from './api.js';
import { isActive, queueWords, upAxisOf } from './documents.js';
import { announce, byId, el, show } from './dom.js';
import { words } from './format.js';
import { canvasOf } from './pictures.js';

const STRIP = 'before-after.png';
const SIZE = [480, 360];
const TINT = [0.9, 0.55, 0.2]; // tells the object from the scene

/** Offers the rendering where the pose may be used, in a field; a rejected one is put into a scene only by whoever insists. */
export function offerInScene(api, job, result) {
  if (job.kind !== 'registration' || result.camera || !['registered', 'ambiguous'].includes(result.verdict)) return;
  const button = byId('render-in-scene');
  button.onclick = async () => {
    button.disabled = true;
    try {
      await renderInScene(api, requestFor(job, upAxisOf(result)));
      show(button, false);
    } catch (error) {
      note(error instanceof ApiProblem ? told(error) : 'The picture could not be made. Try again.');
      button.disabled = false;
    }
  };
  show(button);
  show(byId('in-scene'));
}

/** The picture of a rendering's own job, if it has one. */
export async function showStrip(api, names) {
  if (!names.includes(STRIP)) return;
  const blob = new Blob([await api.artifact(STRIP)]);
  const caption = 'Before, after';
  const canvas = await canvasOf(blob, 'The scene before and after its edits, side by side', null, false);
  byId('in-scene-picture').replaceChildren(el('figure', {}, canvas, el('figcaption', { className: 'note' }, caption)));
  show(byId('in-scene'));
}

async function renderInScene(api, request) {
  note('Requesting the picture');
  let job = await api.startRendering(request);
  const rendering = api.ofJob(job.id);
  while (isActive(job)) {
    note(job.status === 'accepted' ? queueWords(job) : `${words(job.phase ?? 'starting')}, ${Math.round(job.progress * 100)} %`);
    job = await rendering.job({ wait: job.status === 'accepted' ? 1 : 2 });
  }
  if (job.status !== 'successful') throw new ApiProblem(409, job.error ?? { detail: 'The rendering was dismissed.' });
  await showStrip(rendering, [STRIP]);
  byId('in-scene-note').replaceChildren(el('a', { href: job.links.view }, 'The rendering and its files'));
  announce('The picture is displayed.');
}

/** One view of the object from above, and the same of the scene without it; walls before the camera are cut away. */
function requestFor(job, up) {
  return {
    scene: job.inputs.scene,
    edits: [{ kind: 'substitution', job: job.id, tint: TINT }],
    orbit: { edit: 0, frames: 1, up },
    options: { up, cut_away: true },
    size: SIZE,
    outputs: ['strip'],
  };
}

function note(text) {
  byId('in-scene-note').textContent = text;
}
