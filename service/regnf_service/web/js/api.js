// The job's own part of the HTTP API. Every address is below that of the job, which is taken from the address of the page.

import { patientFetch } from './patience.js';

export const TOKEN_KEY = 'regnf.token';

/** What the service answers instead of a result: RFC 9457 problem details. */
export class ApiProblem extends Error {
  constructor(status, problem = {}) {
    super(problem.detail || problem.title || `The service responded with ${status}`);
    this.status = status;
    this.problem = problem;
    this.reason = problem.reason ?? '';
  }
}

/** All that an error says, in sentences: what is wrong, each member of its `errors` with its place, and what helps. */
export const told = (error) => toldOf({ ...error.problem, detail: error.message });

/** The same of a problem object, as a failed job and a refused field have it. */
export function toldOf({ detail, title, errors, hint }) {
  const faults = (errors ?? []).map(({ pointer = '', detail: fault = '' }) => {
    const place = pointer.replace(/^\//, '').replaceAll('/', '.');
    return place ? `${place}: ${fault}` : fault;
  });
  return [detail || title, ...faults, hint].filter(Boolean).map(asSentence).join(' ');
}

const asSentence = (text) => (/[.!?:]$/.test(text) ? text : `${text}.`);

/** "/v1/jobs/ab12/view" is the page of the job at "/v1/jobs/ab12". */
export function jobBase(pathname) {
  return pathname.replace(/\/view\/?$/, '');
}

export class JobApi {
  constructor(base) {
    this.base = base;
  }

  /** The job's id, the last part of its address. */
  get id() {
    return decodeURIComponent(this.base.split('/').pop());
  }

  /** Kept for this tab alone: a token opens more than this one job. */
  get token() {
    return sessionStorage.getItem(TOKEN_KEY);
  }

  set token(value) {
    sessionStorage.setItem(TOKEN_KEY, value);
  }

  artifactUrl(name) {
    return `${this.base}/artifacts/${encodeURIComponent(name)}`;
  }

  async job({ wait = 0, signal } = {}) {
    const response = await this.open(wait ? `?wait=${wait}` : '', { signal });
    return response.json();
  }

  async result() {
    return (await this.open('/result')).json();
  }

  async artifact(name) {
    return (await this.open(`/artifacts/${encodeURIComponent(name)}`)).arrayBuffer();
  }

  /** The picture of a field, a PNG. */
  async fieldPicture(sha256) {
    return (await this.request(`${this.fieldUrl(sha256)}/preview.png`)).blob();
  }

  /** The field's surface as GLB; detail is fine or coarse. */
  async fieldMesh(sha256, detail) {
    return (await this.request(`${this.fieldUrl(sha256)}/mesh.glb?detail=${detail}`)).arrayBuffer();
  }

  /** The field's document. */
  async field(sha256) {
    return (await this.request(this.fieldUrl(sha256))).json();
  }

  /** The picture of what a refused field may be, a PNG; numbers begin with 1. */
  async candidatePicture(sha256, number) {
    return (await this.request(`${this.fieldUrl(sha256)}/candidates/${number}.png`)).blob();
  }

  fieldUrl(sha256) {
    return `${this.root}/fields/${sha256}`;
  }

  /** What every address of the service begins with. */
  get root() {
    return this.base.replace(/\/jobs\/[^/]*$/, '');
  }

  /** The same for another job. */
  ofJob(id) {
    return new JobApi(`${this.root}/jobs/${encodeURIComponent(id)}`);
  }

  /** Asks for a rendering; its job's document. */
  async startRendering(request) {
    const headers = { 'Content-Type': 'application/json' };
    return (await this.request(`${this.root}/render`, { method: 'POST', headers, body: JSON.stringify(request) })).json();
  }

  async cancel() {
    await this.open('/cancel', { method: 'POST' });
  }

  /** A successful response below the job's address; everything else becomes an ApiProblem. */
  async open(path, options) {
    return this.request(this.base + path, options);
  }

  async request(address, { method = 'GET', headers = {}, body, signal } = {}) {
    const authorized = this.token ? { ...headers, Authorization: `Bearer ${this.token}` } : headers;
    const response = await patientFetch(address, { method, headers: authorized, body, signal, cache: 'no-cache' });
    if (response.ok) return response;
    throw new ApiProblem(response.status, await problemOf(response));
  }
}

export async function problemOf(response) {
  try {
    return await response.json();
  } catch {
    return {}; // a proxy in between may answer in HTML; the status still says what happened
  }
}
