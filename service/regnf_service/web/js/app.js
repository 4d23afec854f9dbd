// The page of one job: reads it, follows it while it runs, then shows the result.

import { JobApi, jobBase } from './api.js';
import { showCandidates } from './candidates.js';
import { showCertainty } from './certainty.js';
import { offerConsidered, unchooseConsidered } from './considered.js';
import { artifactsOf, framesOf, isActive } from './documents.js';
import { askFirst, deletionOf } from './confirm.js';
import { announce, byId, copyText, keepPrefix, show } from './dom.js';
import { followJob } from './events.js';
import { showFields } from './fields.js';
import { showInImage } from './in-image.js';
import { offerInScene, showStrip } from './in-scene.js';
import { Turns } from './latest.js';
import { showAgreement } from './metric-list.js';
import { prefersStillness } from './motion.js';
import { Names } from './names.js';
import { showOptions } from './options.js';
import {
  checkPose, offerCamera, showFiles, showJob, showPoses, showTimes, showTransform, showVerdict,
} from './panel.js';
import { Playback } from './playback.js';
import { DistancePlot } from './plot.js';
import { showRanking } from './ranking.js';
import { canRunAgain, runAgain } from './run-again.js';
import { Service } from './service.js';
import { inverse, readSim3 } from './sim3.js';
import { Stage } from './stage.js';
import {
  hideCard, showActive, showBadge, showDismissed, showError, showFailed, showFilesOnly, showLoading, showNoView, showNumbersOnly,
  showTrouble,
} from './status.js';

const api = new JobApi(jobBase(location.pathname));
const fieldNames = new Names(api);
const turns = new Turns();

/** May be called again, to try again or with another token: only the latest call shows what it finds. */
async function main() {
  const isLatest = turns.next();
  const ifLatest = (act) => (...news) => { if (isLatest()) act(...news); };
  showLoading('Reading the job');
  try {
    let job = await api.job();
    if (!isLatest()) return;
    showJob(fieldNames, job);
    showFields(api, fieldNames, job);
    if (isActive(job)) {
      showActive(job);
      job = await followJob(api, job, ifLatest(showActive), ifLatest(showTrouble));
    }
    if (!isLatest()) return;
    showJob(fieldNames, job);
    offerActs(job);
    await showFinished(job);
  } catch (error) {
    ifLatest(showError)(error, main);
  }
  document.documentElement.dataset.page = 'ready';
}

/** What can be done with a job that has ended. */
function offerActs(job) {
  const service = new Service(() => Promise.reject(new Error('The token is not valid. Reload the page.')));
  show(byId('run-again'), canRunAgain(job));
  show(byId('delete-job'));
  byId('run-again').onclick = () => runAgain(service, job);
  byId('delete-job').onclick = async () => {
    if (await askFirst(deletionOf(service, job, byId('job-title').textContent))) location.href = `${api.root}/jobs`;
  };
}

async function showFinished(job) {
  if (job.status === 'failed') {
    showFailed(job);
    await showCandidates(api, job);
  } else if (job.status === 'dismissed') showDismissed(job);
  else await showResult(job, await api.result());
}

async function showResult(job, result) {
  const artifacts = artifactsOf(result);
  const names = artifacts.map(({ name }) => name);
  const trace = names.includes('trace.json') ? await readTrace() : [];
  const frames = framesOf(result, trace);
  showBadge(result.verdict ?? job.status, job.id);
  if (result.verdict) showVerdict(job, result);
  offerInScene(api, job, result);
  showInImage(api, result, names);
  if (job.kind === 'render') await showStrip(api, names);
  showRanking(fieldNames, result.candidates);
  showCertainty(result);
  showOptions(result.options);
  offerCamera(result.camera);
  if (frames.length) showTransform(frames.at(-1).pose);
  await showAgreement(result.metrics);
  showTimes(job, result.metrics);
  showFiles(api, artifacts);
  await showJob(fieldNames, job, result);
  showFields(api, fieldNames, job, result);
  if (!frames.length) showFilesOnly();
  else if (job.inputs?.pictures === false) {
    showNumbersOnly();
    offerPoses(result, frames, () => {});
  } else await showStage(job, result, frames, names);
}

async function showStage(job, result, frames, names) {
  const stage = new Stage(api, names, fieldNames);
  showLoading('Loading the surfaces');
  try {
    await stage.open(job, result, frames);
    hideCard();
  } catch (error) {
    show(byId('canvas'), false);
    showNoView(error);
    offerPoses(result, frames, () => {});
    return;
  }
  const unit = result.metrics?.object_diameter > 0 ? 'of the diameter' : 'object units';
  const curve = new DistancePlot(byId('distance'), frames, unit, (index) => playback.seek(index));
  const playback = new Playback(frames, (position) => {
    stage.moveTo(position);
    curve.moveTo(position);
    stage.showMarks(null);
    unchooseConsidered();
    if (checkPose(0)) showTransform(frames.at(-1).pose); // the path leads to the result, not to an alternative
  });
  show(byId('convergence'), curve.useful);
  byId('distance-note').textContent = curve.note;
  byId('canvas').addEventListener('keydown', (event) => {
    if (event.key !== ' ') return;
    event.preventDefault();
    playback.toggle();
  });
  offerPoses(result, frames, (alternative) => {
    playback.seek(frames.length - 1);
    if (!alternative) return;
    stage.placeAlternative(inverse(alternative));
    playback.nameInstead('Alternative');
  });
  offerConsidered(api, result, names, ({ pose, marks }) => {
    playback.pause();
    stage.placeAlternative(inverse(pose));
    stage.showMarks(marks);
    playback.nameInstead('A candidate pose');
    showTransform(pose, 'A candidate pose');
  });
  announce('The surfaces are displayed.');
  if (!prefersStillness() && frames.length > 1) playback.play();
}

/** Lets the reader choose among the poses; onChoose hears the alternative's T_object_scene, or null for the result's. */
function offerPoses(result, frames, onChoose) {
  const alternatives = (result.alternatives ?? []).filter((one) => readSim3(one?.T_object_scene));
  showPoses(alternatives, result.metrics?.score, (index) => {
    const alternative = index === 0 ? null : readSim3(alternatives[index - 1].T_object_scene);
    onChoose(alternative);
    showTransform(alternative ?? frames.at(-1).pose, alternative ? `An alternative: ${alternatives[index - 1].relation}` : '');
    checkPose(index);
  });
}

async function readTrace() {
  try {
    return JSON.parse(new TextDecoder().decode(await api.artifact('trace.json')));
  } catch {
    return []; // the replay is a courtesy: without the trace it goes straight from the start to the result
  }
}

keepPrefix(api.root);
byId('job-id').textContent = api.id;
byId('copy-id').addEventListener('click', () => copyText(api.id, byId('copy-id')));
byId('cancel').addEventListener('click', async () => {
  byId('cancel').disabled = true;
  try {
    await api.cancel();
  } catch {
    byId('cancel').disabled = false; // finished in the meantime, most likely: the job's own state will say so
  }
});
byId('token-form').addEventListener('submit', (event) => {
  event.preventDefault();
  api.token = byId('token').value.trim();
  main();
});
await main();
