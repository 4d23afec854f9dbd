// What a person can try, by the stable reason of a failure or of a verdict.

const HINTS = {
  NO_SURFACE_IN_DETECTION: 'Check that the detection box is given in the scene field’s own frame and units, and that it encloses the object.',
  NO_SURFACE_IN_OBJECT: 'The object’s field has no zero level where it was looked for. Check its bounds and its sign: positive outside, negative inside.',
  DETECTION_OUTSIDE_SCENE: 'The box lies outside the scene field’s bounds. Check its frame and units.',
  NO_INITIAL_TRANSFORM: 'Too little of the object’s shape is visible in the box, or it is another object. A tighter box or another library object may help.',
  LOW_OVERLAP: 'The surfaces touch only in part. A box that encloses the whole object, and nothing else, helps most.',
  SEVERAL_POSES_AGREE: 'Choose the pose you mean below. If things stand upright, set the option up_axis: poses that do not stand upright are left out.',
  SCENE_UNEXPLAINED: 'Something else, or more than the object, stands in the box. A tighter box or another library object may help.',
  SURFACE_UNEXPLAINED: 'Most often it is a look-alike, like a chair without its cushion. If something lies on the object, a tighter box may help.',
  FREE_SPACE_VIOLATED: 'Most often it is another object, or the scene’s field lacks parts of this one.',
  TOO_LITTLE_SURFACE: 'Hardly anything of the object was seen. More views in the scene’s field help, or a box round more of the object.',
  LARGE_RESIDUAL: 'Most often it is another object. The preset robust, or more iterations, may find a better pose of the right one.',
  WORKER_LOST: 'The worker died twice while on this job, most often for want of memory. Posting the same request starts it anew.',
  JOB_TIMEOUT: 'The job ran into its time limit. Fewer samples make it quicker; the service’s limit is a setting.',
  OUT_OF_MEMORY: 'The worker ran out of memory. Fewer samples need less; a worker with more memory is the other way.',
  FIELD_NOT_RECOGNIZED: 'The file was not recognized as a signed distance field. See the list of formats in the documentation.',
};

export const hintFor = (reason) => HINTS[reason] ?? '';
