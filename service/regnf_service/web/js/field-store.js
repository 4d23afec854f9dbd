// The fields of the service as this page knows them: one list, which every part of the page draws from.

import { Turns } from './latest.js';
import { roleOf } from './roles.js';

export class FieldStore {
  constructor(service) {
    Object.assign(this, { service, fields: [], jobs: [], hearers: [], turns: new Turns(), news: new Map() });
  }

  /** hear() is called after every change, however it came about. */
  onChange(hear) {
    this.hearers.push(hear);
  }

  /** Reads the list anew. What was put in while the answer was on its way is newer than the answer. */
  async load() {
    const isLatest = this.turns.next();
    this.news = new Map();
    const [fields, jobs] = await Promise.all([this.service.all('fields'), this.service.all('jobs')]);
    if (!isLatest()) return;
    const known = new Map(fields.map((field) => [field.sha256, field]));
    for (const [sha256, field] of this.news) known.set(sha256, field);
    const put = [...this.news.keys()].filter((sha256) => !fields.some((field) => field.sha256 === sha256));
    const order = [...put, ...fields.map(({ sha256 }) => sha256)];
    Object.assign(this, { fields: order.map((sha256) => known.get(sha256)), jobs });
    this.tell();
  }

  /** A field's document that has just come: of an upload, or of a change. */
  put(field) {
    this.news.set(field.sha256, field);
    const at = this.fields.findIndex(({ sha256 }) => sha256 === field.sha256);
    this.fields = at < 0 ? [field, ...this.fields] : this.fields.with(at, field);
    this.tell();
  }

  /** Those that can be registered, the library's first. */
  ready() {
    const ready = this.fields.filter(({ state }) => state === 'ready');
    return [...ready.filter(({ library }) => library), ...ready.filter(({ library }) => !library)];
  }

  /** What a field is: 'scene' or 'object'. */
  role(field) {
    return roleOf(field, this.jobs);
  }

  tell() {
    for (const hear of this.hearers) hear();
  }
}
