// Keeps the view moving fast: while it moves, and only where that is slow, fewer triangles and fewer pixels are drawn.

const SLOW_MS = 22; // other work of the page comes on top
const STILL_MS = 180;
const PAUSE_MS = 1000; // longer than any frame takes: nothing was drawn in between
const LEAST_PIXELS = 0.35; // of the screen's own, along each side

export class Mover {
  constructor(viewer) {
    this.viewer = viewer;
    this.times = [];
    this.share = 1;
    this.coarseOnly = false;
    this.held = false;
    viewer.controls.addEventListener('start', () => this.hold(true));
    viewer.controls.addEventListener('end', () => this.hold(false));
    viewer.controls.addEventListener('change', () => this.moved());
  }

  /** A surface and its two geometries; both may be one. Where one frame of the fine one takes long, no movement begins with it. */
  show(surface, fine, coarse) {
    Object.assign(this, { surface, fine, coarse });
    surface.geometry = fine;
    this.viewer.invalidate();
    if (fine !== coarse) requestAnimationFrame(() => requestAnimationFrame(() => this.tryOut()));
  }

  /** Times drawn frames: where the fine geometry is slow, a movement begins with the coarse one and as many pixels as go with it. */
  tryOut() {
    if (this.held || this.last !== undefined) return; // it moves already, and that tells more
    if (this.viewer.timeFrame() <= SLOW_MS) return;
    this.coarseOnly = true;
    this.surface.geometry = this.coarse;
    const took = this.viewer.timeFrame();
    this.surface.geometry = this.fine;
    if (took > SLOW_MS) this.share = Math.max(Math.sqrt(SLOW_MS / took), LEAST_PIXELS);
    this.viewer.invalidate();
  }

  hold(held) {
    this.held = held;
    this.settleSoon();
  }

  moved() {
    const now = performance.now();
    const since = now - (this.last ?? -Infinity);
    if (since < 2) return; // several events of one frame
    this.last = now;
    this.apply(true);
    this.settleSoon();
    if (since > PAUSE_MS) return;
    this.times.push(since);
    if (this.times.length < 3) return;
    const typical = this.times.sort((a, b) => a - b)[1];
    this.times = [];
    if (typical > SLOW_MS) this.cheapen(typical);
  }

  /** Fewer triangles first, then fewer pixels, as many as would be drawn in time; kept for the next movement. */
  cheapen(typical) {
    if (this.coarseOnly || this.fine === this.coarse) this.share = Math.max(this.share * Math.sqrt(SLOW_MS / typical), LEAST_PIXELS);
    this.coarseOnly = true;
    this.apply(true);
  }

  apply(moving) {
    if (this.surface) this.surface.geometry = moving && this.coarseOnly ? this.coarse : this.fine;
    this.viewer.setPixelShare(moving ? this.share : 1);
  }

  settleSoon() {
    clearTimeout(this.stilling);
    if (!this.held) this.stilling = setTimeout(() => this.still(), STILL_MS);
  }

  still() {
    this.last = undefined;
    this.times = [];
    this.apply(false);
    this.viewer.invalidate();
  }
}
