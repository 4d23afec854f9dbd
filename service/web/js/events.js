// Following an active job: server-sent events first, long polling when there are none.
// Events are read from fetch, not from EventSource, which cannot send an access token.

import { ApiProblem } from './api.js';
import { isActive } from './documents.js';

const MERGED = ['status', 'phase', 'progress', 'queue_position', 'error', 'attempts', 'started', 'finished'];
const MAX_PAUSE_MS = 10_000;

/**
 * Calls onChange with the job's document whenever it changes and returns the final one.
 * onTrouble hears whether the service can be reached. Refusals (ApiProblem below 500) are thrown.
 */
export async function followJob(api, job, onChange, onTrouble) {
  let current = job;
  const change = (next) => {
    current = next;
    onChange(next);
  };
  let streaming = true;
  let lastEvent = null;
  let pause = 1000;
  while (isActive(current)) {
    try {
      if (streaming) {
        const before = lastEvent;
        lastEvent = await stream(api, lastEvent, (data) => change(merged(current, data)), () => isActive(current));
        streaming = lastEvent !== before; // a stream that tells nothing new is no better than polling
      }
      change(await api.job({ wait: streaming || !isActive(current) ? 0 : 10 }));
      onTrouble(null);
      pause = 1000;
      if (isActive(current)) await sleep(streaming ? 250 : 1000);
    } catch (error) {
      if (error instanceof ApiProblem && error.status < 500 && error.status !== 429) {
        if (!streaming) throw error;
        streaming = false; // the stream alone may be refused, by a proxy for instance
        continue;
      }
      onTrouble(error);
      await sleep(pause);
      pause = Math.min(pause * 2, MAX_PAUSE_MS);
    }
  }
  return current;
}

function merged(job, data) {
  const known = MERGED.filter((name) => name in data).map((name) => [name, data[name]]);
  return { ...job, ...Object.fromEntries(known) };
}

/** Reads one event stream to its end, or until the job has finished; returns the id of the last event. */
async function stream(api, lastEvent, onData, wanted) {
  const headers = { Accept: 'text/event-stream', ...(lastEvent ? { 'Last-Event-ID': lastEvent } : {}) };
  const abort = new AbortController();
  const response = await api.open('/events', { headers, signal: abort.signal });
  let last = lastEvent;
  try {
    for await (const event of parseEvents(response.body)) {
      if (event.id !== null) last = event.id;
      if (event.data) onData(event.data);
      if (!wanted()) break;
    }
  } finally {
    abort.abort();
  }
  return last;
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
