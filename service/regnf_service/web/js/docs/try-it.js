// The form that sends an operation's request and shows the answer. It sends nothing until its button is pressed.

import { announce, el } from '../dom.js';
import { addressOf, exampleOf, headersOf, isText, typeOf } from './contract.js';
import { token } from './token.js';

const LONGEST_SHOWN = 100000;

export function tryForm(operation) {
  const [mediaType, body] = Object.entries(operation.bodies)[0] ?? [];
  const fields = operation.parameters.map((parameter) => parameterField(operation, parameter));
  const content = mediaType ? bodyField(operation, mediaType, body) : null;
  const answer = el('div', { className: 'answer', role: 'status' });
  const send = el('button', { type: 'submit', className: 'solid' }, `Send ${operation.method.toUpperCase()}`);
  const stop = el('button', { type: 'button', hidden: true }, 'Stop');
  const form = el('form', { className: 'try', noValidate: true }, el('h3', {}, 'Try it'), ...fields,
    ...(content ? [content] : []), el('p', {}, send, ' ', stop), answer);
  form.addEventListener('submit', async (event) => {
    event.preventDefault();
    const control = new AbortController();
    stop.onclick = () => control.abort();
    stop.hidden = false;
    send.disabled = true;
    await perform(operation, form, mediaType, answer, control.signal);
    stop.hidden = true;
    send.disabled = false;
  });
  return form;
}

function parameterField(operation, parameter) {
  const choices = parameter.schema?.enum;
  const input = choices
    ? el('select', { name: parameter.name }, el('option', { value: '' }, ''), ...choices.map((one) => el('option', { value: one }, String(one))))
    : el('input', { type: 'text', name: parameter.name, autocomplete: 'off', spellcheck: false, placeholder: typeOf(parameter.schema) });
  return el('label', {}, `${parameter.name}${parameter.required ? ' (required)' : ''}`, input);
}

function bodyField(operation, mediaType, body) {
  const input = isText(mediaType)
    ? el('textarea', { name: '(body)', spellcheck: false, value: exampleOf(body) })
    : el('input', { type: 'file', name: '(body)' });
  return el('label', {}, `Body, ${mediaType}`, input);
}

async function perform(operation, form, mediaType, answer, signal) {
  const given = new FormData(form);
  const values = Object.fromEntries(operation.parameters.map(({ name }) => [name, String(given.get(name) ?? '')]));
  try {
    const headers = headersOf(operation, values);
    if (token.value) headers.Authorization = `Bearer ${token.value}`;
    const body = mediaType ? given.get('(body)') : undefined;
    if (mediaType) headers['Content-Type'] = mediaType;
    const address = addressOf(operation, values);
    const began = performance.now();
    const response = await fetch(address, { method: operation.method.toUpperCase(), headers, body, signal, cache: 'no-store' });
    const shown = await contentOf(response);
    show(answer, response.ok, `${response.status} ${response.statusText}, ${Math.round(performance.now() - began)} ms`, address, response.headers, shown);
  } catch (error) {
    show(answer, false, error.name === 'AbortError' ? 'Stopped' : error.message);
  }
}

async function contentOf(response) {
  const kind = response.headers.get('Content-Type') ?? '';
  if (kind.startsWith('image/')) return drawn(await response.blob());
  if (!/json|text|yaml/.test(kind)) return el('p', {}, `${(await response.blob()).size} bytes of ${kind || 'no type'}`);
  const text = await response.text();
  return el('pre', { tabIndex: 0 }, shortened(/json/.test(kind) ? pretty(text) : text));
}

/** The page's policy allows no picture by address that the page made itself: it is drawn. */
async function drawn(blob) {
  const picture = await createImageBitmap(blob);
  const canvas = el('canvas', { width: picture.width, height: picture.height, role: 'img', 'aria-label': 'The picture that was answered' });
  canvas.getContext('2d').drawImage(picture, 0, 0);
  return canvas;
}

function pretty(text) {
  try {
    return JSON.stringify(JSON.parse(text), null, 2);
  } catch {
    return text;
  }
}

const shortened = (text) => (text.length > LONGEST_SHOWN ? `${text.slice(0, LONGEST_SHOWN)}\n...` : text);

function show(answer, ok, line, address = '', headers = new Headers(), content = null) {
  answer.dataset.ok = String(ok);
  const told = ['location', 'etag', 'retry-after', 'content-type'].filter((name) => headers.get(name));
  const list = told.map((name) => `${name}: ${headers.get(name)}`).join('\n');
  answer.replaceChildren(el('p', {}, el('strong', {}, line), address ? ` ${address}` : ''),
    ...(list ? [el('pre', {}, list)] : []), ...(content ? [content] : []));
  announce(line);
}
