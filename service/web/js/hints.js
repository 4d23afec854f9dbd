// What a person can try, by the stable reason of a failure or of a verdict.

const HINTS = {
  NO_SURFACE_IN_DETECTION: 'Check that the detection box is given in the scene field’s own frame and units, and that it encloses the object.',
  NO_SURFACE_IN_OBJECT: 'The object’s field has no zero level where it was looked for. Check its bounds and its sign: positive outside, negative inside.',
  DETECTION_OUTSIDE_SCENE: 'The box lies outside the scene field’s bounds. Check its frame and units.',
  NO_INITIAL_TRANSFORM: 'Too little of the object’s shape is visible in the box, or it is another object. A tighter box or another library object may help.',
  LOW_OVERLAP: 'The surfaces touch only in part. A box that encloses the whole object, and nothing else, helps most.',
  WORKER_LOST: 'The worker died twice while on this job, most often for want of memory. Posting the same request starts it anew.',
  JOB_TIMEOUT: 'The job ran into its time limit. Fewer samples make it quicker; the service’s limit is a setting.',
  OUT_OF_MEMORY: 'The worker ran out of memory. Fewer samples need less; a worker with more memory is the other way.',
  FIELD_NOT_RECOGNISED: 'The file was not recognised as a signed distance field. See the list of formats in the documentation.',
};

export const hintFor = (reason) => HINTS[reason] ?? '';
