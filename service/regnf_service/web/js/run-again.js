// The same registration with other options: a form that begins with those of the earlier job.

import { byId } from './dom.js';
import { OptionsForm } from './options-form.js';

/** Opens the form for a registration that has ended. */
export async function runAgain(service, job) {
  const result = job.status === 'successful' ? await service.json(`/jobs/${job.id}/result`) : {};
  const form = new OptionsForm(byId('again-options'), result.options, job.inputs.seed);
  byId('again-note').textContent = '';
  byId('again-start').onclick = async () => {
    byId('again-start').disabled = true;
    try {
      const started = await service.post('/register', requestOf(job, result, form));
      location.href = started.links.view;
    } catch (error) {
      byId('again-note').textContent = `${error.message} ${error.problem?.hint ?? ''}`;
    }
    byId('again-start').disabled = false;
  };
  byId('again-dialog').showModal();
}

function requestOf(job, result, form) {
  const { scene, object, detection } = job.inputs;
  const candidates = object ? null : (result.candidates ?? []).map((one) => one.object);
  return {
    scene,
    ...(object ? { object } : { candidates }),
    detection: { center: detection.center, size: detection.size, rotation_quaternion_xyzw: detection.rotation_quaternion_xyzw },
    ...form.values(result.options?.up_axis ?? 'z'),
  };
}
