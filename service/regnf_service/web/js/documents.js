// Reading the API's documents: what the page needs from them, or null where a document does not say.

import { partsOf, readSim3 } from './sim3.js';

const RENDERING_PHASES = ['loading', 'composing', 'rendering', 'exporting'];
export const PHASES = ['loading', 'sampling', 'initializing', 'optimizing', 'verifying', 'exporting'];

// What a registration may leave behind, for services whose result does not list it.
const KNOWN_ARTIFACTS = ['scene_points.ply', 'object_points.ply', 'trace.json', 'residuals.npz', 'preview.png'];

/** Those that a job goes through. */
export const phasesOf = (job) => (job.kind === 'render' ? RENDERING_PHASES : PHASES);

export const isActive = (job) => job.status === 'accepted' || job.status === 'running';

/** Whether a metric is shown as a bar, in per cent. */
export const isShare = (name, value) => /share|overlap/.test(name) && value >= 0 && value <= 1;

/** { title, meaning, good } of each metric; none where they cannot be had: names must do. */
export async function readSentences() {
  try {
    return await (await fetch('/static/metrics.json')).json();
  } catch {
    return {};
  }
}

/** Where work stands that no worker has yet: a job's or a field's document. */
export function queueWords({ queue_position: position }) {
  if (!Number.isFinite(position)) return 'Waiting for a worker';
  return position <= 1 ? 'Waiting for a worker: this job is next' : `Waiting for a worker: ${position - 1} before it`;
}

/** The detection box { center, size, quaternion } in the scene frame, or null. */
export function detectionOf(job, result) {
  const sources = [job?.inputs, job?.request, result?.inputs, result, job];
  const box = sources.map((source) => source?.detection).find((value) => value && typeof value === 'object');
  if (!box) return null;
  if (isVector(box.min, 3) && isVector(box.max, 3)) {
    const center = box.min.map((low, i) => (low + box.max[i]) / 2);
    return { center, size: box.max.map((high, i) => high - box.min[i]), quaternion: [0, 0, 0, 1] };
  }
  if (!isVector(box.center, 3) || !isVector(box.size, 3)) return null;
  const turn = box.rotation_quaternion_xyzw;
  return { center: box.center, size: box.size, quaternion: isVector(turn, 4) ? turn : [0, 0, 0, 1] };
}

/** The axis of the scene that points up: as the options say, else the one that the camera of a recording has above it. */
export function upAxisOf({ options, camera }) {
  const said = options?.up_axis;
  if (['x', 'y', 'z'].includes(said)) return said;
  const seen = readSim3(camera?.T_scene_camera);
  if (!seen) return 'z';
  const up = seen.elements.slice(4, 7).map((part) => -part); // the camera's y points down
  const axis = up.reduce((best, part, i) => (Math.abs(part) > Math.abs(up[best]) ? i : best), 0);
  return `${up[axis] < 0 ? '-' : ''}${'xyz'[axis]}`;
}

/** The artifacts as [{ name, bytes }], whether they are listed as names, as objects or as a mapping. */
export function artifactsOf(result) {
  const listed = result?.artifacts;
  if (!listed || typeof listed !== 'object') return KNOWN_ARTIFACTS.map((name) => ({ name, bytes: null }));
  const entries = Array.isArray(listed)
    ? listed.map((entry) => (typeof entry === 'string' ? [entry, {}] : [entry?.name, entry]))
    : Object.entries(listed);
  return entries
    .filter(([name]) => typeof name === 'string')
    .map(([name, entry]) => ({ name, bytes: entry?.bytes ?? entry?.size ?? null }));
}

/**
 * The mean distance between the surfaces' samples in an iteration, over both sides alike: a share of the object's diameter
 * where that is known, else in object units. No kernel weighs it. pose is T_object_scene. null where the trace has none.
 */
function distanceOf(row, pose, diameter) {
  const { residual_scene: scene, residual_object: object } = row ?? {};
  if (!Number.isFinite(scene) || !Number.isFinite(object) || !pose) return null;
  const mean = (scene + object * partsOf(pose).scale) / 2; // the object's samples measure in the scene's units
  return diameter > 0 ? mean / diameter : mean;
}

/**
 * The replay: [{ label, iteration, distance, pose }] from the initial transform over the trace to the result.
 * pose is T_object_scene. Iterations without a readable transform are left out.
 */
export function framesOf(result, trace) {
  const frames = [];
  const add = (label, iteration, row, value) => {
    const pose = readSim3(value);
    if (pose) frames.push({ label, iteration, distance: distanceOf(row, pose, result.metrics?.object_diameter), pose });
  };
  add('Start', null, null, result.T_object_scene_initial);
  const rows = Array.isArray(trace) ? trace : (trace?.iterations ?? trace?.trace ?? []);
  rows.forEach((row, i) => {
    const iteration = row?.iteration ?? i + 1;
    add(`Iteration ${iteration}`, iteration, row, row?.T_object_scene);
  });
  add('Result', null, null, result.T_object_scene);
  return frames;
}

/** [{ phase, seconds }] in the order of the phases, from metrics named seconds_<phase> or a mapping `seconds`. */
export function secondsByPhase(metrics = {}) {
  const nested = metrics.seconds ?? metrics.seconds_by_phase ?? {};
  const found = { ...(typeof nested === 'object' ? nested : {}) };
  for (const [name, value] of Object.entries(metrics)) {
    if (name.startsWith('seconds_') && name !== 'seconds_by_phase') found[name.slice('seconds_'.length)] = value;
  }
  delete found.total;
  const rank = (phase) => (PHASES.includes(phase) ? PHASES.indexOf(phase) : PHASES.length);
  return Object.entries(found)
    .filter(([, seconds]) => Number.isFinite(seconds) && seconds >= 0)
    .map(([phase, seconds]) => ({ phase, seconds }))
    .sort((a, b) => rank(a.phase) - rank(b.phase));
}

function isVector(value, length) {
  return Array.isArray(value) && value.length === length && value.every(Number.isFinite);
}
