// The slider and the play button: which frame of the optimizer's path is shown, fractions between frames included.

import { byId, show } from './dom.js';
import { number } from './format.js';

const FLIGHT_MS = 3600;
const PAUSE_MS = 500; // at the start, so that the eye finds the object before it moves

export class Playback {
  /** onMove(position) hears every change; frames as documents.js reads them. */
  constructor(frames, onMove) {
    this.frames = frames;
    this.onMove = onMove;
    this.position = frames.length - 1;
    this.playing = 0;
    this.slider = byId('iteration');
    this.button = byId('play');
    this.slider.max = String(frames.length - 1);
    this.slider.addEventListener('input', () => this.seek(Number(this.slider.value)));
    this.button.addEventListener('click', () => this.toggle());
    show(byId('timeline'), frames.length > 1);
    this.moveTo(this.position);
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  play() {
    const last = this.frames.length - 1;
    const from = this.position >= last ? 0 : this.position;
    const begun = performance.now() + (from === 0 ? PAUSE_MS : 0);
    const step = (now) => {
      const share = Math.max(now - begun, 0) / FLIGHT_MS;
      this.moveTo(Math.min(from + share * last, last));
      if (this.position < last) this.playing = requestAnimationFrame(step);
      else this.pause();
    };
    this.playing = requestAnimationFrame(step);
    this.showState();
  }

  pause() {
    cancelAnimationFrame(this.playing);
    this.playing = 0;
    this.showState();
  }

  /** Stops there. */
  seek(position) {
    this.pause();
    this.moveTo(position);
  }

  moveTo(position) {
    this.position = position;
    const frame = this.frames[Math.round(position)];
    const distance = frame.distance === null ? '' : ` · distance ${number(frame.distance, 3)}`;
    this.slider.value = String(Math.round(position));
    this.slider.setAttribute('aria-valuetext', frame.label + distance);
    byId('iteration-text').textContent = frame.label + distance;
    this.onMove(position);
  }

  /** Says that something else than a frame of the path is shown, until it moves again. */
  nameInstead(label) {
    byId('iteration-text').textContent = label;
    this.slider.setAttribute('aria-valuetext', label);
  }

  showState() {
    this.button.setAttribute('aria-label', this.playing ? 'Pause' : "Play the optimizer's iterations");
    this.button.toggleAttribute('data-playing', Boolean(this.playing));
  }
}
