// The residuals of both surfaces' samples, as clouds colored along a ramp.

import { Cloud, geometryFromArrays } from './cloud.js';
import { readNpz } from './npz.js';

const TOP_SHARE = 0.97; // the ramp ends here: a few stray samples must not make all others look alike

/**
 * { scene, object, sizes, top } from the bytes of residuals.npz: a Cloud for each surface, each in its own frame,
 * all absolute residuals and the ramp's upper end, in object units. `plain` are the clouds shown otherwise.
 * Raises Error when the file holds none.
 */
export async function readResiduals(buffer, plain) {
  const arrays = await readNpz(buffer);
  const sizes = ['scene', 'object'].flatMap((side) => absolute(arrays[`${side}_residuals`]));
  if (sizes.length === 0) throw new Error('the file has no residuals');
  const top = [...sizes].sort((a, b) => a - b)[Math.floor((sizes.length - 1) * TOP_SHARE)] || 1e-9;
  const cloud = (side, like) => {
    const points = arrays[`${side}_points`];
    const values = absolute(arrays[`${side}_residuals`]);
    if (!points || values.length === 0 || points.data.length !== values.length * 3) return null;
    const made = new Cloud(geometryFromArrays(points.data, values.map((value) => value / top), like.geometry), like.style);
    made.colorBy('residual');
    return made;
  };
  return { scene: cloud('scene', plain.scene), object: cloud('object', plain.after), sizes, top };
}

const absolute = (array) => (array ? Array.from(array.data, (value) => Math.abs(Number(value))) : []);
