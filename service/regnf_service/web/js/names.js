// What people call the fields of a job: their labels, else their family and the beginning of the digest.

import { nameOf } from './uploads.js';

export class Names {
  constructor(api) {
    this.api = api;
    this.documents = new Map(); // sha256 -> promise of the field's document, or of null
  }

  /** The field's document, asked for once, or null where the service has it no more. */
  document(sha256) {
    if (!/^[0-9a-f]{64}$/.test(sha256 ?? '')) return Promise.resolve(null);
    if (!this.documents.has(sha256)) this.documents.set(sha256, this.api.field(sha256).catch(() => null));
    return this.documents.get(sha256);
  }

  async of(sha256) {
    const field = await this.document(sha256);
    return field ? nameOf(field) : String(sha256 ?? '').slice(0, 12);
  }

  /** The chair in the room; the object of a search may be known only by its result. */
  async ofJob(job, result = null) {
    const { scene, candidates } = job.inputs ?? {};
    const object = result?.object ?? job.inputs?.object;
    if (job.kind === 'render') return `Rendering of ${await this.of(scene)}`;
    if (!object) return `One of ${candidates ?? 'several'} objects in ${await this.of(scene)}`;
    const [what, where] = await Promise.all([this.of(object), this.of(scene)]);
    return `${what} in ${where}`;
  }
}
