// The fields and recordings of the service as this page knows them: lists that every part of the page draws from.

import { Turns } from './latest.js';
import { isRecording } from './recordings.js';
import { roleOf } from './roles.js';

export class FieldStore {
  constructor(service) {
    Object.assign(this, { service, fields: [], recordings: [], jobs: [], hearers: [], turns: new Turns(), news: new Map() });
  }

  /** hear() is called after every change, however it came about. */
  onChange(hear) {
    this.hearers.push(hear);
  }

  /** Reads the lists anew. What was put in while the answer was on its way is newer than the answer. */
  async load() {
    const isLatest = this.turns.next();
    this.news = new Map();
    const lists = ['fields', 'recordings', 'jobs'].map((name) => this.service.all(name));
    const [fields, recordings, jobs] = await Promise.all(lists);
    if (!isLatest()) return;
    Object.assign(this, { fields, recordings, jobs });
    for (const document of this.news.values()) this.take(document);
    this.tell();
  }

  /** A document that has just come, of a field or a recording: of an upload, or of a change. */
  put(document) {
    this.news.set(document.sha256, document);
    this.take(document);
    this.tell();
  }

  take(document) {
    const name = isRecording(document) ? 'recordings' : 'fields';
    const at = this[name].findIndex(({ sha256 }) => sha256 === document.sha256);
    this[name] = at < 0 ? [document, ...this[name]] : this[name].with(at, document);
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
