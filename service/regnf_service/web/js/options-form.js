// The options that people change, with the contract's defaults: what is left alone is left out of the request.

import { el } from './dom.js';

const NUMBERS = [
  ['min_scale', 'Least scale, object units for each scene unit, if known', null, 1e-6, 1e6],
  ['max_scale', 'Largest scale, if known', null, 1e-6, 1e6],
  ['rotations', 'Rotations to start from', 600, 24, 20000],
  ['box_tolerance', 'How far the object may reach beyond the box, of its edge', 1, 0, 10],
  ['inlier_distance', 'Largest residual of an inlier, diameters', 0.015, 0.0001, 0.2],
  ['min_probability', 'Minimum probability of an answer', 0.7, 0, 1],
  ['share_limits_below', 'Below this probability, the three shares count too', 0.9, 0, 1],
  ['min_inlier_share', 'Least share of inliers', 0.6, 0.01, 1],
  ['min_explained_share', 'Least share of the box that is explained', 0.4, 0.01, 1],
  ['max_occluded_share', 'Most of the object that is not seen', 0.85, 0.01, 1],
];

export class OptionsForm {
  /** Fills host with one row an option. given: options of a result, shown as they are. */
  constructor(host, given = {}, seed = 0) {
    this.preset = select(['robust', 'paper'], given.preset ?? 'robust');
    this.upright = select(['stands upright', 'any way up'], given.up_axis ? 'stands upright' : 'any way up');
    this.seed = el('input', { type: 'number', min: 0, max: 2 ** 32 - 1, step: 1, value: String(seed) });
    this.numbers = NUMBERS.map(([name, , usual, low, high]) => {
      const value = given.robust?.[name] ?? usual;
      return [name, usual, el('input', { type: 'number', min: low, max: high, step: 'any', value: String(value ?? '') })];
    });
    const rows = [['Preset', this.preset], ['The object', this.upright], ['Seed', this.seed]];
    const all = [...rows, ...this.numbers.map(([, , node], i) => [NUMBERS[i][1], node])];
    host.replaceChildren(...all.flatMap(([words, node], i) => {
      node.id = `${host.id}-${i}`;
      return [el('label', { className: 'note', htmlFor: node.id }, words), node];
    }));
  }

  /** What a request takes: { options, seed }. up: the scene's up axis, x, y or z. */
  values(up) {
    const robust = Object.fromEntries(
      this.numbers.filter(([, usual, node]) => Number.isFinite(node.valueAsNumber) && node.valueAsNumber !== usual)
        .map(([name, , node]) => [name, node.valueAsNumber]),
    );
    const options = { preset: this.preset.value };
    if (this.upright.value === 'stands upright') options.up_axis = up.replace('-', '');
    if (options.preset === 'robust' && Object.keys(robust).length) options.robust = robust;
    return { options, seed: this.seed.valueAsNumber || 0 };
  }
}

function select(values, chosen) {
  return el('select', {}, ...values.map((value) => el('option', { value, selected: value === chosen }, value)));
}
