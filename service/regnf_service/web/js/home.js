// The home page: a scene, objects, boxes around things or marks in pictures, and what the service makes of them.

import { told } from './api.js';
import { BoxList } from './box-list.js';
import { byId, keepPrefix, show } from './dom.js';
import { FieldStore } from './field-store.js';
import { MarkList } from './mark-list.js';
import { maskShape } from './mask.js';
import { ObjectList } from './object-list.js';
import { OptionsForm } from './options-form.js';
import { PictureView } from './picture-view.js';
import { isRecording } from './recordings.js';
import { nameOf } from './uploads.js';
import { Runs } from './runs.js';
import { SceneChoice } from './scene-choice.js';
import { Service } from './service.js';
import { askForToken } from './token.js';
import { Workspace } from './workspace.js';

const service = new Service(askForToken);
const options = new OptionsForm(byId('options-form'), service);
const store = new FieldStore(service);
let workspace = null;
let starting = false;

const objects = new ObjectList(service, store, update);
const scene = new SceneChoice(service, store, { onScene: showScene, onMask: takeMask }, objects);
const boxes = new BoxList(() => workspace, update);
const pictures = new PictureView((shape, mark) => marks.take(shape, mark));
const marks = new MarkList(() => pictures, update);
let list = boxes; // what is marked in the scene that is shown
const runs = new Runs(service, () => (list === marks ? pictures : workspace), options);

/** Shows a ready field or recording as the scene; isLatest(): whether no other one was chosen since. */
async function showScene(field, up, isLatest) {
  const recorded = isRecording(field);
  if (workspace) boxes.clear();
  marks.clear();
  list = recorded ? marks : boxes;
  runs.clear();
  delete document.documentElement.dataset.scene;
  objects.leaveOut(field.sha256);
  show(byId('welcome'), false);
  for (const id of ['canvas', 'gizmo', 'handles']) show(byId(id), !recorded);
  for (const id of ['pictures', 'unit-row']) show(byId(id), recorded);
  byId('stage').classList.toggle('of-pictures', recorded);
  byId('boxes-title').textContent = list.title;
  byId('add-box').textContent = list.one;
  list.draw();
  update();
  await (recorded ? showRecording(field) : showField(field, up, isLatest));
  if (isLatest()) document.documentElement.dataset.scene = field.sha256;
}

async function showField(field, up, isLatest) {
  workspace ??= new Workspace(byId('canvas'), byId('gizmo'), byId('handles'), {
    onClick: (point) => boxes.click(point),
    onBox: (box) => boxes.edited(box),
  });
  tell(`${nameOf(field)}: its surface is being drawn.`);
  await workspace.showScene(service, field.sha256, up);
  if (isLatest()) tell(`${nameOf(field)}: click the object to register.`);
}

async function showRecording(recording) {
  tell(`${nameOf(recording)}: click the object to register, or draw a box around it.`);
  await pictures.open(service, recording);
}

/** Marks what a mask, a PNG, shows in the picture. */
async function takeMask(file) {
  const { frame } = pictures;
  marks.take(await maskShape(frame, file));
}

function tell(text) {
  byId('tip').textContent = text;
  show(byId('tip'), text !== '');
}

/** What is missing before anything can be registered. */
function update() {
  const missing = [
    [!scene.field, 'a scene'], [!objects.chosen().length, 'an object'], [!list.boxes.length, list.wanted],
  ].filter(([is]) => is).map(([, words]) => words);
  byId('register').disabled = starting || missing.length > 0;
  byId('add-box').disabled = !scene.field;
  byId('missing').textContent = missing.length ? `Missing: ${missing.join('; ')}.` : '';
  if (list.boxes.length) tell(objects.chosen().length ? '' : 'Now add the object.');
}

byId('register').addEventListener('click', async () => {
  starting = true;
  update();
  try {
    list.rest();
    await runs.start(scene.field, objects.chosen(), list, list === marks ? byId('object-unit').value : 'auto');
  } finally {
    starting = false;
    update();
  }
});
byId('add-box').addEventListener('click', () => list.add());
byId('scene-up').addEventListener('change', () => {
  boxes.clear();
  workspace?.setUp(byId('scene-up').value);
});
byId('canvas').addEventListener('keydown', (event) => {
  if (event.key.toLowerCase() !== 'b' || event.ctrlKey || event.metaKey || event.altKey) return;
  const { left, top, width, height } = byId('canvas').getBoundingClientRect();
  const point = workspace.hit({ clientX: left + width / 2, clientY: top + height / 2 });
  if (point) boxes.click(point);
});

async function load() {
  try {
    await store.load();
  } catch (error) {
    tell(`The fields could not be listed: ${told(error)} Reload the page later.`);
  }
}

byId('options').addEventListener('toggle', async () => {
  try {
    await options.load();
    byId('options-note').textContent = '';
  } catch (error) {
    byId('options-note').textContent = told(error);
  }
});
addEventListener('pageshow', (event) => { if (event.persisted) load(); }); // the way back may show the page as it was left
keepPrefix(service.root);
update();
await Promise.all([load(), scene.load()]);
document.documentElement.dataset.page = 'ready';
