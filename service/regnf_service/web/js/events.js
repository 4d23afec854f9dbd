// Following an active job: server-sent events while it runs, long polling while it waits or where there are no events.
// Events are read from fetch, not from EventSource, which cannot send an access token.

import { ApiProblem } from './api.js';
import { isActive } from './documents.js';

const MERGED = ['status', 'phase', 'progress', 'error'];
const MAX_PAUSE_MS = 10_000;
const LONG_POLL_S = 5; // a place in the queue changes without an event

/**
 * Calls onChange with the active job's document whenever it changes and returns the document of the finished one.
 * onTrouble hears whether the service can be reached. Refusals (ApiProblem below 500) are thrown.
 */
export async function followJob(api, job, onChange, onTrouble) {
  const state = { job, streaming: true, lastEvent: null, pause: 1000 };
  while (isActive(state.job)) {
    try {
      await followOnce(api, state, onChange);
      onTrouble(null);
      state.pause = 1000;
      if (isActive(state.job)) await sleep(state.streaming ? 250 : 1000);
    } catch (error) {
      if (error instanceof ApiProblem && error.status < 500 && error.status !== 429) throw error;
      onTrouble(error);
      await sleep(state.pause);
      state.pause = Math.min(state.pause * 2, MAX_PAUSE_MS);
    }
  }
  return state.job;
}

/** One stream to its end, where there is one, and the job's document, which alone decides whether it has finished. */
async function followOnce(api, state, onChange) {
  const update = (next) => {
    state.job = next;
    if (isActive(next)) onChange(next);
  };
  if (state.streaming && state.job.status === 'running') {
    const before = state.lastEvent;
    const begun = state.job;
    try {
      await stream(api, state, (data) => {
        if (isNews(begun, data)) update(merged(state.job, data));
        return isActive(state.job);
      });
    } catch (error) {
      if (!(error instanceof ApiProblem)) throw error;
      state.streaming = false; // the stream alone may be refused, by a proxy for instance
    }
    if (state.lastEvent === before) state.streaming = false; // a stream that tells nothing is no better than polling
    update(await api.job());
  } else {
    update(await api.job({ wait: LONG_POLL_S }));
  }
}

// A stream begins with the events of the past, of earlier attempts too; the document is newer than those.
function isNews(job, data) {
  return !(data.attempt < job.attempts) && !(data.updated * 1000 + 1 < Date.parse(job.updated_at));
}

function merged(job, data) {
  const known = MERGED.filter((name) => name in data).map((name) => [name, data[name]]);
  return { ...job, ...Object.fromEntries(known), attempts: data.attempt ?? job.attempts };
}

/** Reads one event stream to its end, or until onData returns false; state.lastEvent resumes a broken one. */
async function stream(api, state, onData) {
  const resume = state.lastEvent ? { 'Last-Event-ID': state.lastEvent } : {};
  const abort = new AbortController();
  const response = await api.open('/events', { headers: { Accept: 'text/event-stream', ...resume }, signal: abort.signal });
  try {
    for await (const event of parseEvents(response.body)) {
      if (event.id !== null) state.lastEvent = event.id;
      if (event.data && !onData(event.data)) break;
    }
  } finally {
    abort.abort();
  }
}

/** The events of a text/event-stream body: { id, name, data } with data parsed as JSON. */
export async function* parseEvents(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let buffer = '';
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    buffer = (buffer + value).replaceAll('\r\n', '\n');
    const blocks = buffer.split('\n\n');
    buffer = blocks.pop();
    for (const block of blocks) {
      const event = parseBlock(block);
      if (event) yield event;
    }
  }
}

function parseBlock(block) {
  const event = { id: null, name: 'message', data: null };
  const data = [];
  for (const line of block.split('\n')) {
    const at = line.indexOf(':');
    if (at === 0) continue; // a comment: the server's keep-alive
    const name = at < 0 ? line : line.slice(0, at);
    const value = at < 0 ? '' : line.slice(at + 1).replace(/^ /, '');
    if (name === 'data') data.push(value);
    else if (name === 'id') event.id = value;
    else if (name === 'event') event.name = value;
  }
  if (data.length === 0) return event.id === null ? null : event;
  try {
    event.data = JSON.parse(data.join('\n'));
  } catch {
    event.data = null; // not ours; the next document tells the state anyway
  }
  return event;
}

const sleep = (milliseconds) => new Promise((resolve) => { setTimeout(resolve, milliseconds); });
