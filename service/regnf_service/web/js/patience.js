// A service that is busy says when to ask again: its store of records, or a worker that has yet to draw a field or a job.

const MOST_RETRIES = 6;
const MOST_LOOKS = 60;
const LONGEST_PAUSE_S = 10;

/** fetch() that asks again, when told to, after a 503, 404 or 409 to a GET: nothing was done then, or is done twice. */
export async function patientFetch(address, options = {}) {
  for (let tries = 0; ; tries += 1) {
    const response = await fetch(address, options);
    const told = Number.parseFloat(response.headers.get('Retry-After'));
    if ((options.method ?? 'GET') !== 'GET' || !(told >= 0) || tries >= (await mostTries(response))) return response;
    const pause = response.status === 503 ? told : Math.min(told * 1.3 ** tries, LONGEST_PAUSE_S);
    await new Promise((resolve) => setTimeout(resolve, 1000 * pause));
    options.signal?.throwIfAborted();
  }
}

async function mostTries(response) {
  if (response.status === 503) return MOST_RETRIES;
  if (response.status === 404) return MOST_LOOKS; // one that says when is of a picture to come
  if (response.status !== 409) return 0;
  const problem = await response.clone().json().catch(() => ({}));
  return problem.reason === 'ARTIFACT_NOT_READY' ? MOST_LOOKS : 0;
}
