// Two results side by side, and how far their poses are apart.

import { byId, el } from './dom.js';
import { fixed, moment, number, words } from './format.js';
import { inverse, partsOf, readSim3 } from './sim3.js';

/** Opens the comparison of two jobs; names.nameOf(job) is what people call one. */
export async function compareJobs(service, jobs, names) {
  const results = await Promise.all(jobs.map(({ id }) => service.json(`/jobs/${id}/result`)));
  const head = el('tr', {}, el('th', { scope: 'col' }, ''), ...jobs.map((job) => el('th', { scope: 'col' }, names.nameOf(job), el('br'), el('small', {}, moment(job.created_at)))));
  const rows = [
    ['Verdict', results.map(({ verdict }) => words(verdict))],
    ['Why', results.map(({ verdict_reason: reason }) => words(reason))],
    ['Seed', results.map(({ seed }) => String(seed))],
    ...rowsOf(results.map(({ metrics }) => metrics ?? {})),
    ...rowsOf(results.map(({ options }) => ({ preset: options?.preset, up_axis: options?.up_axis, ...options?.robust })), true),
  ];
  byId('comparison').replaceChildren(
    el('thead', {}, head),
    el('tbody', {}, ...apart(results), ...rows.map(([name, cells]) => row(name, cells))),
  );
  byId('compare-dialog').showModal();
}

/** The rows of plain values; differing: of those alone that differ. */
function rowsOf(values, differing = false) {
  const names = [...new Set(values.flatMap(Object.keys))];
  return names.map((name) => [words(name), values.map((value) => shown(value[name]))])
    .filter(([, cells]) => cells.some((cell) => cell !== null) && !(differing && cells[0] === cells[1]));
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

function shown(value) {
  if (typeof value === 'number') return number(value, 4);
  return typeof value === 'string' || typeof value === 'boolean' ? String(value) : null;
}
