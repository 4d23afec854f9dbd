// The uncertainty of the pose: standard deviations, the covariance they come from, and the object's own symmetry.

import { byId, el, fillFacts, show } from './dom.js';
import { number } from './format.js';

const AXES = ['x', 'y', 'z'];
const [FULL_DEGREES, FULL_SHARE, FULL_PERCENT] = [1, 0.01, 1]; // the share is of the object's diameter

/** Bars of fixed scales, alike for all results: a full one is much for a pose that somebody wants to use. */
export function showCertainty(result) {
  const { uncertainty, covariance, covariance_ordering: ordering, symmetry } = result;
  if (uncertainty) {
    const diameter = (result.metrics?.object_diameter ?? NaN) * (result.T_scene_object?.scale ?? NaN);
    byId('sigmas').replaceChildren(
      ...group('The object’s center, along the scene’s axes', 'scene units', AXES, uncertainty.center_scene, FULL_SHARE * diameter),
      ...group('Rotation about the object’s axes', 'degrees', AXES, uncertainty.rotation_deg, FULL_DEGREES),
      ...group('Scale', '%', [''], [uncertainty.scale_percent], FULL_PERCENT),
    );
  }
  byId('certainty-words').textContent = inWords(result);
  if (covariance && ordering) byId('covariance').replaceChildren(...matrixRows(covariance, ordering));
  show(byId('covariance-details'), Boolean(covariance && ordering));
  fillFacts(byId('symmetry'), [['Symmetry of the object', symmetry ? symmetryInWords(symmetry) : null]]);
  show(byId('certainty'), Boolean(uncertainty || symmetry));
}

/** How well the pose is known if it is the right one, in one sentence: of each kind the largest standard deviation. */
function inWords({ uncertainty, metrics, T_scene_object: pose }) {
  const most = (values) => Math.max(...(values ?? [NaN]));
  const [center, turn, scale] = [most(uncertainty?.center_scene), most(uncertainty?.rotation_deg), uncertainty?.scale_percent];
  const share = (100 * center) / ((metrics?.object_diameter ?? NaN) * (pose?.scale ?? NaN));
  const parts = [
    Number.isFinite(center) && `its center within ± ${number(center, 2)} scene units${Number.isFinite(share) ? `, ${number(share, 2)} % of its size` : ''}`,
    Number.isFinite(turn) && `its rotation within ± ${number(turn, 2)}°`,
    Number.isFinite(scale) && `its scale within ± ${number(scale, 2)} %`,
  ].filter(Boolean);
  return parts.length ? `If the pose is correct, it is known: ${parts.join('; ')}.` : '';
}

/** { order, axis, continuous } in words. */
export function symmetryInWords({ order, axis, continuous }) {
  const about = axis ? ` about (${axis.map((value) => (Math.round(value * 100) / 100 + 0).toFixed(2)).join(', ')})` : '';
  if (continuous) return `any rotation${about}${order > 1 ? ', and upside down' : ''}`;
  return order === 1 ? 'none found' : `${order} rotations${about} look the same`;
}

function group(name, unit, labels, values, whole) {
  const largest = Number.isFinite(whole) ? whole : Math.max(...values.filter(Number.isFinite), 0);
  const rows = labels.map((label, i) => {
    const fill = el('span', {});
    fill.style.width = `${Number.isFinite(values[i]) && largest > 0 ? Math.min(100, (100 * values[i]) / largest) : 0}%`;
    return el('div', { className: 'sigma' }, el('span', { className: 'mono' }, label),
      el('span', { className: 'track', 'aria-hidden': 'true' }, fill),
      el('span', { className: 'mono' }, `± ${number(values[i], 2)}`));
  });
  const said = Number.isFinite(whole) ? `${unit}; full bar ${number(whole, 2)}` : unit;
  return [el('h3', {}, name, ' ', el('small', {}, said)), ...rows];
}

function matrixRows(covariance, ordering) {
  const head = el('tr', {}, el('td', {}), ...ordering.map((name) => el('th', { scope: 'col' }, name)));
  const rows = covariance.map((row, i) => el('tr', {}, el('th', { scope: 'row' }, ordering[i]), ...row.map((value, j) => el(
    'td', i === j ? { className: 'own' } : {}, number(value, 2),
  ))));
  return [el('thead', {}, head), el('tbody', {}, ...rows)];
}
