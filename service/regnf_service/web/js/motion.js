// Whether the reader has asked for less motion: nothing then moves that nobody started.

export const prefersStillness = () => matchMedia('(prefers-reduced-motion: reduce)').matches;
