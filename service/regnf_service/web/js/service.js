// The service as the home page and the lists use it. Every address is below the root of the page's own address.

import { ApiProblem, JobApi, TOKEN_KEY, problemOf } from './api.js';
import { bytes } from './format.js';
import { patientFetch } from './patience.js';

const FOLLOW_S = 4; // its place in the queue changes meanwhile, which ends no wait

export class Service {
  /** onToken() is asked for a token, as a promise, whenever the service wants one. */
  constructor(onToken) {
    this.root = /^\/v1(\/|$)/.test(location.pathname) ? '/v1' : '';
    this.onToken = onToken;
  }

  get token() {
    return sessionStorage.getItem(TOKEN_KEY);
  }

  job(id) {
    return new JobApi(`${this.root}/jobs/${encodeURIComponent(id)}`);
  }

  /** A successful response; everything else becomes an ApiProblem. A 401 asks for the token and tries again. */
  async request(path, options = {}) {
    for (;;) {
      const { headers = {}, ...rest } = options;
      const { token } = this;
      const authorized = token ? { ...headers, Authorization: `Bearer ${token}` } : headers;
      const response = await patientFetch(this.root + path, { cache: 'no-cache', ...rest, headers: { Accept: '*/*', ...authorized } });
      if (response.ok) return response;
      if (response.status !== 401) throw new ApiProblem(response.status, await problemOf(response));
      if (this.token !== token) continue; // somebody has entered one since this was asked
      sessionStorage.setItem(TOKEN_KEY, await this.onToken());
    }
  }

  async json(path, options) {
    return (await this.request(path, options)).json();
  }

  async post(path, body) {
    const options = { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body) };
    return this.json(path, options);
  }

  /** The field's document, or null where there is none. */
  async field(sha256, wait = 0) {
    try {
      return await this.json(`/fields/${sha256}${wait ? `?wait=${wait}` : ''}`);
    } catch (error) {
      if (error.status === 404) return null;
      throw error;
    }
  }

  /** The field's document once its import has ended; onNews hears of it until then. */
  async imported(sha256, onNews = () => {}) {
    for (let wait = 0; ; wait = FOLLOW_S) {
      const field = await this.field(sha256, wait);
      if (!field || field.state !== 'validating') return field;
      onNews(field);
    }
  }

  /** Gives a field a name for people; its document. */
  async label(sha256, label) {
    const options = { method: 'PATCH', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ label }) };
    return this.json(`/fields/${sha256}`, options);
  }

  /** All of a list, at most `most`: name is fields, recordings, jobs or library. */
  async all(name, most = 400) {
    const found = [];
    let page = '';
    do {
      const document = await this.json(`/${name}?limit=200${page}`);
      found.push(...(document[name] ?? document.entries));
      page = document.next_page_token && `&page_token=${encodeURIComponent(document.next_page_token)}`;
    } while (page && found.length < most);
    return found;
  }

  /** The field's surface as GLB; detail is fine or coarse. */
  async mesh(sha256, detail) {
    return (await this.request(`/fields/${sha256}/mesh.glb?detail=${detail}`, { cache: 'default' })).arrayBuffer();
  }

  async picture(sha256) {
    return (await this.request(`/fields/${sha256}/preview.png`, { cache: 'default' })).blob();
  }

  /** Sends a file with its description; onProgress hears the share and words for it. The field's document. */
  upload(file, description, onProgress) {
    const form = new FormData();
    form.append('description', JSON.stringify(description));
    form.append('file', file, file.name);
    return this.send('/fields', form, {}, onProgress);
  }

  /** The answer to a POST whose body may be large. */
  send(path, body, headers, onProgress) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest(); // fetch tells nothing of what it has sent
      request.open('POST', this.root + path);
      for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
      if (this.token) request.setRequestHeader('Authorization', `Bearer ${this.token}`);
      request.responseType = 'json';
      request.upload.onprogress = ({ loaded, total }) => onProgress(loaded / total, `${bytes(loaded)} of ${bytes(total)}`);
      request.onload = () => {
        if (request.status < 300) resolve(request.response);
        else reject(new ApiProblem(request.status, request.response ?? {}));
      };
      request.onerror = () => reject(new ApiProblem(0, { detail: 'The connection was lost. Send the file again.' }));
      request.send(body);
    });
  }
}
