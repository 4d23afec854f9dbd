// The options of a registration. Names, defaults, ranges and meanings are the contract's; the first few have shorter words.

import { el } from './dom.js';
import { number, words } from './format.js';

const FIRST = {
  min_scale: 'Min. scale, object units per scene unit',
  max_scale: 'Max. scale',
  box_tolerance: 'Box tolerance (× box edge)',
  inlier_distance: 'Inlier distance (object diameters)',
  acceptance: 'Accept at level',
  min_probability: 'Or accept at probability ≥',
  rotations: 'Start rotations',
};
const UPRIGHT = 'is upright';

export class OptionsForm {
  /** Fills host with one row an option; load() adds those of the contract. given: options of a result. */
  constructor(host, service, given = {}, seed = 0) {
    Object.assign(this, { host, service, given, fields: [] });
    this.preset = select(['robust', 'paper'], given.preset ?? 'robust');
    this.upright = select([UPRIGHT, 'any orientation'], given.up_axis ? UPRIGHT : 'any orientation');
    this.seed = el('input', { type: 'number', min: 0, max: 2 ** 32 - 1, step: 1, value: String(seed) });
    this.list = el('div', { className: 'options-form' });
    host.replaceChildren(...row(host, 'Preset', this.preset), ...row(host, 'The object', this.upright), ...row(host, 'Seed', this.seed), this.list);
    this.preset.onchange = () => this.list.toggleAttribute('hidden', this.preset.value !== 'robust');
    this.preset.onchange();
  }

  /** Reads the contract and adds its options, once. */
  load() {
    this.loading ??= this.service.json('/openapi.json').then((contract) => this.fill(contract)).catch((error) => {
      this.loading = null; // the next time may be luckier
      throw error;
    });
    return this.loading;
  }

  fill(contract) {
    const { properties } = contract.components.schemas.RobustOptions;
    const rows = Object.entries(properties).map(([name, schema]) => [name, this.row(name, schema)]);
    const first = Object.keys(FIRST).flatMap((name) => rows.filter(([one]) => one === name));
    const rest = rows.filter(([name]) => !(name in FIRST));
    const more = el('details', { className: 'wider' }, el('summary', {}, 'More options'), el('div', { className: 'options-form' }, ...rest.flatMap(([, nodes]) => nodes)));
    this.list.replaceChildren(...first.flatMap(([, nodes]) => nodes), more);
  }

  row(name, schema) {
    const usual = schema.default ?? null;
    const given = this.given.robust?.[name] ?? usual;
    const kind = schema.type ? schema : schema.anyOf?.find(({ type }) => type !== 'null') ?? {};
    const field = kind.type === 'number' || kind.type === 'integer' ? numberField(kind, given, usual) : choiceField(kind, given, usual);
    field.node.title = schema.description ?? '';
    this.fields.push({ name, read: field.read });
    return row(this.host, FIRST[name] ?? words(name), field.node);
  }

  /**
   * What a request takes: { options, seed }. What is left at its default is left out. up: the scene's up axis, null where
   * it is not known. unit: of the objects' files, where it is asked for beside the form.
   */
  values(up, unit = 'auto') {
    const robust = Object.fromEntries(this.fields.map(({ name, read }) => [name, read()]).filter(([, value]) => value !== undefined));
    const options = { preset: this.preset.value };
    if (unit !== 'auto') robust.object_unit = unit;
    if (up && this.upright.value === UPRIGHT) options.up_axis = up.replace('-', '');
    if (options.preset === 'robust' && Object.keys(robust).length) options.robust = robust;
    return { options, seed: this.seed.valueAsNumber || 0 };
  }
}

/** { node, read }: empty, with the default behind it, unless another value was given. read(): a number, or undefined. */
function numberField({ minimum, maximum }, given, usual) {
  const range = { ...(minimum !== undefined && { min: minimum }), ...(maximum !== undefined && { max: maximum }) };
  const value = given === usual ? '' : String(given);
  const node = el('input', { type: 'number', ...range, step: 'any', value, placeholder: usual === null ? 'not given' : number(usual) });
  return { node, read: () => (Number.isFinite(node.valueAsNumber) ? node.valueAsNumber : undefined) };
}

/** The same of anything else: its values as they are written in JSON. */
function choiceField({ type, enum: listed }, given, usual) {
  const values = [...new Set([usual, ...(type === 'boolean' ? [true, false] : listed ?? [])])];
  const node = select(values.map((value) => JSON.stringify(value)), JSON.stringify(given));
  return { node, read: () => (node.value === JSON.stringify(usual) ? undefined : JSON.parse(node.value)) };
}

let made = 0;

function row(host, label, node) {
  made += 1;
  node.id = `${host.id}-${made}`;
  return [el('label', { className: 'note', htmlFor: node.id }, label), node];
}

function select(values, chosen) {
  return el('select', {}, ...values.map((value) => el('option', { value, selected: value === chosen }, value)));
}
