// What people call fields and jobs: fields by their labels, else by their family and the beginning of the digest.

import { number } from './format.js';
import { nameOf } from './uploads.js';

/** The chair in the room. of(sha256): a field's name; found: the object of a search, as far as it is known. */
export function titleOfJob(job, of, found = job.object_found) {
  const { scene, object, candidates } = job.inputs ?? {};
  if (job.kind === 'render') return `Rendering of ${of(scene)}`;
  if (object) return `${of(object)} in ${of(scene)}`;
  if (job.verdict === 'rejected') return `None of ${candidates ?? 'several'} objects in ${of(scene)}`;
  return `${found ? of(found) : `One of ${candidates ?? 'several'} objects`} in ${of(scene)}`;
}

/** The box that a job looked in, in the scene's units, or the image; several in one scene are told apart by it. */
export function boxOfJob(job) {
  const [seen] = [job.inputs?.detection ?? {}].flat();
  if (isInImage(job)) return `${imageWords(seen)} in image ${seen.frame ?? 0}`;
  const { center, size } = seen;
  if (!center || !size) return '';
  return `box ${size.map((edge) => number(edge, 3)).join(' × ')} at ${center.map((part) => number(part, 3)).join(', ')}`;
}

/** Whether a job looked for a thing in images of a recording. */
export const isInImage = ({ inputs }) => [inputs?.detection ?? {}].flat().some(({ mask, box_2d: box, point_2d: point }) => mask || box || point);

function imageWords({ box_2d: box, point_2d: point }) {
  const list = (values) => values.map((part) => number(part, 4)).join(', ');
  if (point) return `pixel ${list(point)}`;
  return box ? `box ${list(box)}` : 'mask';
}

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
    return field ? nameOf(field) : shortOf(sha256);
  }

  /** The chair in the room; the object of a search may be known only by its result. */
  async ofJob(job, result = null) {
    const found = result?.object ?? job.object_found;
    const known = [job.inputs?.scene, job.inputs?.object, found];
    const names = new Map(await Promise.all(known.map(async (sha256) => [sha256, await this.of(sha256)])));
    return titleOfJob({ ...job, verdict: result?.verdict ?? job.verdict }, (sha256) => names.get(sha256), found);
  }
}

/** What stands for a field that the service has no more. */
export const shortOf = (sha256) => String(sha256 ?? '').slice(0, 8);
