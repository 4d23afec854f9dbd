// The surfaces of a result as meshes: the object's, the scene's in the detection box, and what surrounds that.

import { clippedGeometry, insideOf, surroundingsOf } from './clip.js';
import { geometryFromGlb } from './glb.js';
import { Surface, isOriented } from './surface.js';

/**
 * { scene, context, before, after } as Surfaces, or null where the scene or the object has no mesh to look at, as a field
 * that is too slow for one, or that was deleted. samples: the scene's points, by which the open side is found.
 * detail: coarse or fine.
 */
export async function meshesOf(api, names, { scene, object }, box, samples, detail) {
  const geometries = await Promise.all([scene, object].map((sha256) => geometryOf(api, names, sha256, detail)));
  if (!geometries.every(Boolean)) return null;
  const [around, thing] = geometries;
  const open = isOriented(around);
  const part = (clip) => new Surface(clip ? clippedGeometry(around, clip) : around, { open, plain: true, clip });
  const made = {
    scene: part(box && insideOf(box)),
    context: box ? part(surroundingsOf(box)) : null,
    before: new Surface(thing, { opacity: 0.35, plain: true }),
    after: new Surface(thing, { plain: true, nearer: true }),
  };
  made.scene.samples = samples;
  return made;
}

async function geometryOf(api, names, sha256, detail) {
  const field = await names.document(sha256);
  if (!field?.links?.mesh) return null;
  try {
    return geometryFromGlb(await api.fieldMesh(sha256, detail));
  } catch {
    return null; // not every field has one
  }
}
