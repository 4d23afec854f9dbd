// What was dropped on the page: files, and folders, for a recording mostly lies in one.

import { archiveOf } from './archive.js';
import { DEPTH } from './frame-files.js';

const FEW = 12;

/** The files of a drop, as a promise. To be called while the event is handled: afterwards its data are gone. */
export async function filesOf(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  const folders = entries.filter((entry) => entry.isDirectory);
  if (!folders.length) return [...transfer.files];
  const files = await Promise.all(entries.filter((entry) => entry.isFile).map(fileOf));
  const held = await Promise.all(folders.map(async (folder) => ofFolder(folder.name, await filesIn(folder, ''))));
  return [...files, ...held.flat()];
}

/** A folder with one frame is its files; any other one is an archive. */
function ofFolder(name, found) {
  const isFrame = found.length <= FEW && found.filter(({ path }) => DEPTH.test(path)).length <= 1;
  return isFrame ? found.map(({ file }) => file) : [archiveOf(name, found)];
}

/** [{ path, file }] of all that is in a folder; hidden files are left out. */
async function filesIn(folder, path) {
  const reader = folder.createReader();
  const entries = [];
  for (;;) {
    const some = await new Promise((resolve, reject) => { reader.readEntries(resolve, reject); }); // a hundred at a time
    if (!some.length) break;
    entries.push(...some.filter(({ name }) => !name.startsWith('.')));
  }
  const found = await Promise.all(entries.map(async (entry) => (entry.isDirectory
    ? filesIn(entry, `${path}${entry.name}/`)
    : [{ path: path + entry.name, file: await fileOf(entry) }])));
  return found.flat();
}

const fileOf = (entry) => new Promise((resolve, reject) => { entry.file(resolve, reject); });
