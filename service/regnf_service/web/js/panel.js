// The results beside the view: verdict, transform, times, downloads, the job itself.

import { secondsByPhase } from './documents.js';
import { byId, copyText, el, fillFacts, show } from './dom.js';
import { bytes, fixed, moment, number, percent, seconds, words } from './format.js';
import { Turns } from './latest.js';
import { inverse, partsOf, readSim3, rowsOf } from './sim3.js';

const turns = new Turns();
let toCamera = null; // T_camera_scene, of a scene that is a recording
const DIRECTIONS = {
  T_scene_object: 'T_scene_object, the object’s pose in the scene: maps object coordinates to scene coordinates',
  T_object_scene: 'T_object_scene: maps scene coordinates to object coordinates',
  T_camera_object: 'T_camera_object, the object’s pose in the camera frame: maps object coordinates to meters, x right, y down, z forward',
};

export function showVerdict(job, result) {
  const { verdict, verdict_reason: reason, metrics = {} } = result;
  byId('verdict').dataset.verdict = verdict;
  byId('verdict-word').textContent = words(verdict);
  const why = el('span', {}, result.verdict_detail || words(reason));
  byId('verdict-reason').replaceChildren(why, ' ', el('code', { title: 'Stable reason, for programs' }, reason ?? ''));
  const hint = result.verdict_hint;
  if (hint) byId('verdict-reason').append(el('span', { className: 'hint' }, hint));
  showWarnings(result.fields);
  const scale = readSim3(result.T_object_scene);
  const deviation = result.uncertainty?.scale_percent;
  const { waited, worked } = timesOf(job, metrics);
  const { probability, level } = result;
  const meant = verdict === 'ambiguous' ? 'that one of the poses listed is right' : 'that the pose is right';
  const reached = level ? `level ${level}` : 'below both levels';
  fillFacts(byId('figures'), [
    ...(Number.isFinite(probability) ? [['Probability', figure(percent(probability, 1), level === undefined ? meant : `${meant}; ${reached}`)]] : []),
    ['Residual RMS', figure(percent(metrics.residual_rms, 2), 'of the diameter')],
    ['Scale, object ← scene', figure(scale ? fixed(partsOf(scale).scale, 4) : '–',
      Number.isFinite(deviation) ? `± ${number(deviation, 2)} %` : '')],
    ['Inliers', figure(percent(Math.min(metrics.inlier_share_scene, metrics.inlier_share_object)), 'the smaller of scene and object')],
    ['Time', figure(seconds(waited ?? worked), waited === null ? '' : `from request to result, ${seconds(worked)} of it computing`)],
  ]);
  show(byId('verdict'));
}

/** What the imports of scene and object were not sure of: a line each. */
function showWarnings(fields) {
  const lines = ['scene', 'object'].flatMap((name) => {
    const warnings = fields?.[name]?.warnings;
    return Array.isArray(warnings) ? warnings.map((warning) => `${words(name)}: ${warning}`) : [];
  });
  byId('warnings').replaceChildren(...lines.map((line) => el('li', {}, line)));
  show(byId('warnings'), lines.length > 0);
}

/** Has the transform shown in the frame of the camera too, if there is one. */
export function offerCamera(camera) {
  const seen = readSim3(camera?.T_scene_camera);
  toCamera = seen && inverse(seen);
  show(byId('camera-direction'), Boolean(toCamera));
}

/** The matrix in both directions, as text to read and to copy; note says whose it is when it is not the result's. */
export function showTransform(matrix, note = '') {
  byId('transform-note').textContent = note;
  show(byId('transform-note'), note !== '');
  const shown = { T_object_scene: matrix, T_scene_object: inverse(matrix) };
  if (toCamera) shown.T_camera_object = toCamera.clone().multiply(shown.T_scene_object);
  const direction = () => document.querySelector('input[name="direction"]:checked').value;
  const draw = () => {
    const current = shown[direction()];
    const { position, quaternion, scale } = partsOf(current);
    byId('matrix-caption').textContent = DIRECTIONS[direction()];
    byId('matrix').replaceChildren(...rowsOf(current).map((row) => el('tr', {}, ...row.map((value) => el('td', {}, fixed(value))))));
    fillFacts(byId('sim3'), [
      ['Scale', mono(fixed(scale, 6))],
      ['Translation', mono(position.toArray().map((value) => fixed(value, 4)).join('  '))],
      ['Quaternion xyzw', mono(quaternion.toArray().map((value) => fixed(value, 4)).join('  '))],
    ]);
  };
  for (const input of document.querySelectorAll('input[name="direction"]')) input.onchange = draw;
  const copy = byId('copy-matrix');
  copy.onclick = () => copyText(rowsAsText(rowsOf(shown[direction()])), copy);
  draw();
  show(byId('transform'));
}

export function showTimes(job, metrics = {}) {
  const rows = secondsByPhase(metrics);
  const sum = rows.reduce((total, row) => total + row.seconds, 0);
  const { waited } = timesOf(job, metrics);
  byId('time-total').textContent = `${seconds(sum)}${waited === null ? ' in all' : ` of ${seconds(waited)} from request to result`}`;
  byId('time-stack').replaceChildren(...rows.map((row, i) => {
    const part = el('span', { 'data-slot': String(i % 6), title: `${words(row.phase)} ${seconds(row.seconds)}` });
    part.style.flexGrow = String(Math.max(row.seconds / (sum || 1), 0.004));
    return part;
  }));
  byId('time-key').replaceChildren(...rows.map((row, i) => el(
    'li', { 'data-slot': String(i % 6) }, el('span', {}, words(row.phase)), el('span', { className: 'mono' }, seconds(row.seconds)),
  )));
  show(byId('time'), rows.length > 0);
}

/** One radio button a pose; onChoose(index) with 0 for the result itself, whose score is given apart. */
export function showPoses(alternatives, score, onChoose) {
  const poses = [{ relation: 'The result', score }, ...alternatives];
  byId('pose-list').replaceChildren(el('legend', { className: 'unseen' }, 'Pose shown'), ...poses.map((pose, i) => {
    const input = el('input', { type: 'radio', name: 'pose', value: String(i), checked: i === 0, onchange: () => onChoose(i) });
    const score = Number.isFinite(pose.score) ? el('span', { className: 'mono' }, number(pose.score, 3)) : '';
    return el('label', {}, input, el('span', {}, pose.relation || `Pose ${i + 1}`), score);
  }));
  show(byId('poses'), alternatives.length > 0);
}

/** Marks a pose as the one shown; true when that changed something. */
export function checkPose(index) {
  const input = byId('pose-list').querySelectorAll('input')[index];
  if (!input || input.checked) return false;
  input.checked = true;
  return true;
}

export function showFiles(api, artifacts) {
  byId('files').replaceChildren(...artifacts.map(({ name, bytes: size }) => {
    const link = el('a', { href: api.artifactUrl(name), download: name }, name);
    if (api.token) link.onclick = (event) => saveWithToken(event, api, name);
    return el('li', {}, link, el('span', { className: 'mono note' }, bytes(size)));
  }));
  show(byId('downloads'), artifacts.length > 0);
}

/** The job itself; names.js says what its fields are called. Their digests are the names' titles. */
export async function showJob(names, job, result) {
  const isLatest = turns.next();
  const engine = result?.engine ?? job.engine ?? {};
  const named = result?.candidates && result.object ? { 'object found': result.object } : {};
  const texts = Object.entries({ ...job.inputs, ...named }).filter(([, value]) => typeof value === 'string' && value !== '');
  const inputs = await Promise.all(texts.map(async ([name, value]) => [words(name), await valueOf(names, name, value)]));
  const title = await names.ofJob(job, result);
  if (!isLatest()) return;
  document.title = `${title} – regnf`;
  byId('job-title').textContent = title;
  fillFacts(byId('job-facts'), [
    ['Id', mono(job.id ?? '')],
    ['Kind', job.kind],
    ['Attempts', String(job.attempts ?? job.attempt ?? '')],
    ['Created', moment(job.created_at)],
    ['Finished', moment(job.finished_at)],
    ['Expires', moment(job.expires_at)],
    ['Start', job.inputs?.initial_transform ? 'given with the request' : null],
    ['Seed', mono(String(result?.seed ?? job.inputs?.seed ?? ''))],
    ['Engine', typeof engine === 'string' ? engine : Object.values(engine).filter((value) => typeof value !== 'object').join(' · ')],
    ...inputs,
  ].map(([term, value]) => [term, value instanceof Node && !value.textContent ? null : value]));
  show(byId('about'));
}

/** Of the inputs only fields have names: the digest of the options looks like a field's. */
const FIELDS = ['scene', 'object', 'object found'];

const valueOf = async (names, name, value) => (FIELDS.includes(name) && /^[0-9a-f]{64}$/.test(value)
  ? el('span', { title: value }, await names.of(value))
  : mono(value));

// A plain link cannot carry the token, so the bytes come through fetch and are saved from memory.
async function saveWithToken(event, api, name) {
  event.preventDefault();
  const url = URL.createObjectURL(new Blob([await api.artifact(name)]));
  el('a', { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

/** Seconds from the request to the result, null where the job does not say, and those of the phases. */
function timesOf(job, metrics) {
  const waited = (Date.parse(job.finished_at) - Date.parse(job.created_at)) / 1000;
  const rows = secondsByPhase(metrics);
  const sum = rows.length ? rows.reduce((total, row) => total + row.seconds, 0) : NaN;
  const worked = Number.isFinite(metrics.seconds_total) ? metrics.seconds_total : sum;
  return { waited: Number.isFinite(waited) ? waited : null, worked };
}

const rowsAsText = (rows) => `[${rows.map((row) => `[${row.join(', ')}]`).join(',\n ')}]`;
const mono = (text) => el('span', { className: 'mono' }, text);
const figure = (value, note) => el('span', {}, el('strong', {}, value), el('small', {}, note));
