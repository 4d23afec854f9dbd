// The poses that were judged, rejected ones too: each to look at, with what the samples held out for that say of it.

import { byId, el, fillFacts, show } from './dom.js';
import { number, percent, sure } from './format.js';
import { readNpz } from './npz.js';
import { inverse, readSim3 } from './sim3.js';

const ROWS = [
  ['Score, lower is better', 'score', (value) => number(value, 3)],
  ['Object inliers', 'inlier_share_object', percent], ['Scene inliers', 'inlier_share_scene', percent],
  ['Object in free space', 'free_space_violations', percent], ['Object unobserved', 'occluded_share_object', percent],
  ['Scene unexplained', 'unexplained_share_scene', percent],
];
const AGREES = 'SURFACES_AGREE';
/** Of the signs in considered.npz, the property of the style sheet that colors them; others are not drawn. */
const OBJECT_SIGNS = { 1: 'sign-free', 2: 'sign-unseen' };
const SCENE_SIGNS = { 1: 'sign-unexplained' };

/** onChoose({ pose, marks }) hears of each choice: T_object_scene, and what speaks against it, or null where that is not known. */
export function offerConsidered(api, result, names, onChoose) {
  const poses = (result.considered ?? []).filter((one) => readSim3(one?.T_object_scene));
  let arrays = null;
  const choose = async (index) => {
    const { metrics = {}, T_object_scene: matrix } = poses[index];
    fillFacts(byId('considered-facts'), [
      ['Probability', sureOf(poses[index])],
      ...ROWS.map(([term, name, format]) => [term, Number.isFinite(metrics[name]) ? format(metrics[name]) : null]),
    ]);
    arrays ??= names.includes('considered.npz') ? api.artifact('considered.npz').then(readNpz).catch(() => null) : null;
    const read = await arrays;
    if (!byId('considered-list').querySelectorAll('input')[index]?.checked) return; // another pose was chosen meanwhile
    show(byId('considered-key'), Boolean(read));
    onChoose({ pose: readSim3(matrix), marks: read && marksOf(read, index, inverse(readSim3(matrix))) });
  };
  byId('considered-list').replaceChildren(el('legend', { className: 'unseen' }, 'Candidate pose'), ...poses.map((one, i) => {
    const input = el('input', { type: 'radio', name: 'considered', value: String(i), onchange: () => choose(i) });
    const words = one.reason === AGREES ? 'The surfaces match.' : one.detail || one.reason;
    return el('label', { title: one.reason }, input, el('span', {}, words), el('span', { className: 'mono' }, sureOf(one) ?? '–'));
  }));
  show(byId('considered'), poses.length > 0);
}

const sureOf = ({ metrics, level }) => (Number.isFinite(metrics?.probability) ? sure(metrics.probability, level) : null);

/** No pose of this list is the one shown. */
export function unchooseConsidered() {
  for (const input of byId('considered-list').querySelectorAll('input')) input.checked = false;
}

/** [{ name, positions, all, tint, pose }]: one cloud for each color, of all samples of that side; pose is null for the scene's. */
function marksOf(arrays, index, pose) {
  const object = Object.entries(OBJECT_SIGNS).map(([sign, tint]) => marked(arrays, 'object', index, Number(sign), tint, pose));
  const scene = Object.entries(SCENE_SIGNS).map(([sign, tint]) => marked(arrays, 'scene', index, Number(sign), tint, null));
  return [...object, ...scene];
}

function marked(arrays, side, index, sign, tint, pose) {
  const [points, signs] = [arrays[`${side}_points`], arrays[`${side}_signs`]];
  const count = points.shape[0];
  const chosen = [...Array(count).keys()].filter((i) => signs.data[index * count + i] === sign);
  const positions = chosen.flatMap((i) => [...points.data.subarray(3 * i, 3 * i + 3)]);
  return { name: `${side}-${sign}`, positions, all: points.data, tint, pose };
}
