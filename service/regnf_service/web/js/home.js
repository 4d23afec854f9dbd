// The home page: a scene, objects, boxes around things, and what the service makes of them.

import { BoxList } from './box-list.js';
import { byId, show } from './dom.js';
import { ObjectList } from './object-list.js';
import { OptionsForm } from './options-form.js';
import { nameOf } from './uploads.js';
import { Runs } from './runs.js';
import { SceneChoice } from './scene-choice.js';
import { Service } from './service.js';
import { askForToken, keepPrefix } from './token.js';
import { Workspace } from './workspace.js';

const service = new Service(askForToken);
const options = new OptionsForm(byId('options-form'));
let workspace = null;

const objects = new ObjectList(service, update);
const scene = new SceneChoice(service, showScene, objects);
const boxes = new BoxList(() => workspace, update);
const runs = new Runs(service, () => workspace, options);

/** Shows a ready field as the scene. */
async function showScene(field, up) {
  show(byId('welcome'), false);
  show(byId('canvas'));
  show(byId('gizmo'));
  workspace ??= new Workspace(byId('canvas'), byId('gizmo'), byId('handles'), {
    onClick: (point) => boxes.click(point),
    onBox: (box) => boxes.edited(box),
  });
  boxes.clear();
  runs.clear();
  objects.leaveOut(field.sha256);
  update();
  tell(`${nameOf(field)}: its surface is being drawn.`);
  await workspace.showScene(service, field.sha256, up);
  tell(`${nameOf(field)}: click the thing to look for.`);
  document.documentElement.dataset.scene = field.sha256;
}

function tell(text) {
  byId('tip').textContent = text;
  show(byId('tip'), text !== '');
}

/** What is missing before anything can be registered. */
function update() {
  const missing = [
    [!scene.field, 'a scene'], [!objects.chosen().length, 'an object'], [!boxes.boxes.length, 'a box: click a thing in the scene'],
  ].filter(([is]) => is).map(([, words]) => words);
  byId('register').disabled = missing.length > 0;
  byId('add-box').disabled = !scene.field;
  byId('missing').textContent = missing.length ? `Missing: ${missing.join('; ')}.` : '';
  if (boxes.boxes.length) tell(objects.chosen().length ? '' : 'Now add the object that this may be.');
}

byId('register').addEventListener('click', async () => {
  byId('register').disabled = true;
  try {
    boxes.rest();
    await runs.start(scene.field, objects.chosen(), boxes.boxes);
  } finally {
    byId('register').disabled = false;
  }
});
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

keepPrefix(service.root);
update();
try {
  await Promise.all([objects.load(), scene.load()]);
} catch (error) {
  tell(`The fields could not be listed: ${error.message} Reload the page later.`);
}
document.documentElement.dataset.page = 'ready';
