// What files are to a recording: a whole one, or the parts of one frame. Told by their first bytes and their names.

import { archiveOf, namesIn } from './archive.js';

const BAGS = ['\x89MCAP0', '#ROSBAG', 'SQLite'];
const IMAGE = /\.(png|jpe?g|bmp|webp|tiff?|exr|npy)$/i;
export const DEPTH = /depth.*\.(png|tiff?|exr|npy)$/i;
const OF_A_FIELD = /\.(ckpt|pth?|safetensors|msgpack|ingp|glb|gltf|obj|stl)$/i;
const CAMERA_TEXT = /(intrinsic|camera|cam_params|calib|cam_k|^k).*\.txt$/i;
const CAMERA_BYTES = 65_536;
const CAMERA_WORDS = /"(fx|fl_x|K|k|cam_K|intrinsics?|intrinsic_matrix|camera_matrix|focal_length|ppx)"/;

/**
 * { recording, depth, color, mask, camera, settings, rest }: a file each where there is one. camera: intrinsics as JSON;
 * settings: a text that may hold them; rest: those that are no part of a recording, without JSON that is nothing to the
 * page. A mask is a picture that is called one. Several depth images are a recording, with all that came with them.
 */
export async function sorted(files) {
  const found = { rest: [] };
  const kinds = await Promise.all(files.map(kindOf));
  if (kinds.filter((kind) => kind === 'depth').length > 1) {
    return { recording: archiveOf('frames', files.map((file) => ({ path: file.name, file }))), rest: [] };
  }
  for (const [i, kind] of kinds.entries()) {
    if (kind === 'nothing') continue;
    if (kind === 'rest' || kind in found) found.rest.push(files[i]);
    else found[kind] = files[i];
  }
  return found;
}

async function kindOf(file) {
  const head = new Uint8Array(await file.slice(0, 256).arrayBuffer());
  const begin = String.fromCharCode(...head.subarray(0, 8));
  if (BAGS.some((magic) => begin.startsWith(magic))) return 'recording';
  if (begin.startsWith('\x89PNG')) return kindOfPng(file, head);
  if (begin.startsWith('\xff\xd8\xff') || begin.startsWith('BM') || begin.startsWith('RIFF')) return 'color';
  if (begin.startsWith('II*\0') || begin.startsWith('MM\0*') || /\.exr$/i.test(file.name)) return 'depth';
  if (begin.startsWith('\x93NUMPY')) return sizeOfNpy(head) ? 'depth' : 'rest';
  if (/\.json$/i.test(file.name) && !/^\s*\{\s*"asset"/.test(begin)) {
    const words = file.size <= CAMERA_BYTES ? await file.text() : '';
    return CAMERA_WORDS.test(words) ? 'camera' : 'nothing';
  }
  if (/\.ya?ml$/i.test(file.name) || CAMERA_TEXT.test(file.name)) return 'settings';
  if (/\.npz$/i.test(file.name)) return 'rest';
  return isOfRecording(await namesIn(file)) ? 'recording' : 'rest';
}

/** Whether an archive with files of these names is a recording: a bag or images, and no trained field. */
export function isOfRecording(names) {
  if (names.some((name) => /\.(mcap|bag|db3)$/i.test(name) || DEPTH.test(name))) return true;
  return names.some((name) => IMAGE.test(name)) && !names.some((name) => OF_A_FIELD.test(name));
}

function kindOfPng({ name }, head) {
  if (/mask/i.test(name)) return 'mask';
  const [bits, colors] = [head[24], head[25]];
  return colors === 0 && (bits === 16 || /depth/i.test(name)) ? 'depth' : 'color';
}

/** [width, height] of a depth image, null where its first bytes do not say. */
export async function sizeOf(depth) {
  const head = new Uint8Array(await depth.slice(0, 256).arrayBuffer());
  if (head[0] !== 0x89) return sizeOfNpy(head);
  const view = new DataView(head.buffer);
  return [view.getUint32(16), view.getUint32(20)];
}

function sizeOfNpy(head) {
  const [, rows, columns] = /'shape':\s*\((\d+),\s*(\d+),?\s*\)/.exec(new TextDecoder().decode(head)) ?? [];
  return rows ? [Number(columns), Number(rows)] : null;
}
