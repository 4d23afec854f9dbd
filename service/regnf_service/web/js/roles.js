// Whether a field is a scene to look in or an object to look for. The service does not ask; the page guesses, and people
// can say otherwise, for this browser.

const KEY = 'regnf.roles';
const ENCLOSES = 0.5; // more than this share of the bounds' faces inside matter: a room, seen from within

/** By what was said here, the library, the upload's description, earlier jobs, and the surface, in this order. */
export function roleOf(field, jobs = []) {
  const { sha256, library, description, report } = field;
  const said = readSaid()[sha256] ?? (library ? 'object' : description?.as);
  if (said) return said;
  if (jobs.some(({ inputs }) => inputs?.object === sha256)) return 'object';
  if (jobs.some(({ inputs }) => inputs?.scene === sha256)) return 'scene';
  return report?.plausibility?.share_inside_at_bounds > ENCLOSES ? 'scene' : 'object';
}

/** What a person says that a field is. */
export function sayRole(sha256, role) {
  try {
    localStorage.setItem(KEY, JSON.stringify({ ...readSaid(), [sha256]: role }));
  } catch {
    // storage that is closed to the page: the guess stays
  }
}

function readSaid() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) ?? {};
  } catch {
    return {}; // storage that is closed to the page, or not ours
  }
}
