// Of several answers only the one to the latest question counts, in whichever order they arrive.

export class Turns {
  #last = 0;

  /** Begins another turn; the function returned tells, at any later time, whether it is still the latest. */
  next() {
    this.#last += 1;
    const mine = this.#last;
    return () => mine === this.#last;
  }
}
