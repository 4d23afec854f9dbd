// Two results side by side, and how far their poses are apart.

import { told } from './api.js';
import { isShare, readSentences } from './documents.js';
import { byId, el } from './dom.js';
import { fixed, moment, number, percent, words } from './format.js';
import { inverse, partsOf, readSim3 } from './sim3.js';

/** Opens the comparison of two jobs; names.nameOf(job) is what people call one. */
export async function compareJobs(service, jobs, names) {
  byId('comparison').replaceChildren(el('caption', { className: 'note' }, 'Reading the results'));
  byId('compare-dialog').showModal(); // at once: nothing else can be chosen while the answers are on their way
  byId('compare-title').focus();
  try {
    const [about, ...results] = await Promise.all([readSentences(), ...jobs.map(({ id }) => service.json(`/jobs/${id}/result`))]);
    draw(jobs, results, about, names);
  } catch (error) {
    byId('comparison').replaceChildren(el('caption', { className: 'bad' }, told(error)));
  }
}

function draw(jobs, results, about, names) {
  const head = el('tr', {}, el('th', { scope: 'col' }, ''), ...jobs.map((job) => el('th', { scope: 'col' }, names.nameOf(job), el('br'), el('small', {}, moment(job.created_at)))));
  const metrics = results.map(({ metrics: values }) => values ?? {});
  const options = results.map(({ options: given }) => ({ preset: given?.preset, up_axis: given?.up_axis, ...given?.robust }));
  const rows = [
    ['Verdict', results.map(({ verdict }) => words(verdict))],
    ['Level', results.map(({ level, probability }) => (Number.isFinite(probability) ? level ?? 'below both levels' : null))],
    ['Why', results.map(({ verdict_reason: reason, verdict_detail: detail }) => detail || words(reason))],
    ['Seed', results.map(({ seed }) => String(seed))],
    ...rowsOf(metrics, (name) => about[name]?.title ?? words(name)),
    ...rowsOf(options, (name) => `Option: ${words(name).toLowerCase()}`).filter(([, cells]) => cells[0] !== cells[1]),
  ];
  byId('comparison').replaceChildren(
    el('thead', {}, head),
    el('tbody', {}, ...apart(results), ...rows.map(([name, cells]) => row(name, cells))),
  );
}

/** The rows of plain values, under the words that the page of a job has for them. */
function rowsOf(values, titleOf) {
  const names = [...new Set(values.flatMap(Object.keys))];
  return names.map((name) => [titleOf(name), values.map((value) => shown(name, value[name]))])
    .filter(([, cells]) => cells.some((cell) => cell !== null));
}

function row(name, cells) {
  return el('tr', { className: cells[0] === cells[1] ? '' : 'differs' }, el('th', { scope: 'row' }, name), ...cells.map((cell) => el('td', {}, cell ?? '–')));
}

/** From one pose to the other, in the scene. */
function apart(results) {
  const [first, second] = results.map(({ T_scene_object: pose }) => readSim3(pose));
  if (!first || !second) return [];
  const [from, to] = results.map(({ center_scene: center }) => center ?? []);
  const { quaternion, scale } = partsOf(second.clone().multiply(inverse(first)));
  const between = Math.hypot(...[0, 1, 2].map((i) => to[i] - from[i]));
  const turn = 2 * Math.acos(Math.min(Math.abs(quaternion.w), 1));
  const text = `turned by ${fixed((turn * 180) / Math.PI, 2)}°, centers ${number(between, 3)} apart, scale × ${number(scale, 4)}`;
  return [el('tr', {}, el('th', { scope: 'row' }, 'Second pose from the first'), el('td', { colSpan: 2 }, text))];
}

function shown(name, value) {
  if (typeof value === 'number') return isShare(name, value) || /probability|violations/.test(name) ? percent(value) : number(value, 4);
  return typeof value === 'string' || typeof value === 'boolean' ? String(value) : null;
}
