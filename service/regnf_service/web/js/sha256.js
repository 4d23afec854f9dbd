// SHA-256 of a file, piece by piece. crypto.subtle wants all bytes at once and exists on encrypted sites alone.

const PIECE = 4 << 20;
const FIRST = [0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19];
const K = roundConstants();

/** The digest of a Blob in hexadecimal digits; onProgress hears the share that is done. */
export async function sha256Of(blob, onProgress = () => {}) {
  const hash = new Sha256();
  for (let at = 0; at < blob.size; at += PIECE) {
    hash.feed(new Uint8Array(await blob.slice(at, at + PIECE).arrayBuffer()));
    onProgress(Math.min(at + PIECE, blob.size) / blob.size);
  }
  return hash.end();
}

export class Sha256 {
  constructor() {
    this.state = Int32Array.from(FIRST);
    this.schedule = new Int32Array(64);
    this.rest = new Uint8Array(0);
    this.length = 0;
  }

  feed(bytes) {
    this.length += bytes.length;
    let at = 0;
    if (this.rest.length) {
      at = Math.min(64 - this.rest.length, bytes.length);
      this.rest = joined(this.rest, bytes.subarray(0, at));
      if (this.rest.length < 64) return;
      this.blocks(this.rest, 0, 64);
    }
    const end = bytes.length - ((bytes.length - at) % 64);
    this.blocks(bytes, at, end);
    this.rest = bytes.slice(end);
  }

  end() {
    const last = new Uint8Array(this.rest.length < 56 ? 64 : 128);
    last.set(this.rest);
    last[this.rest.length] = 0x80;
    const view = new DataView(last.buffer);
    view.setUint32(last.length - 8, Math.floor(this.length / 2 ** 29));
    view.setUint32(last.length - 4, (this.length * 8) >>> 0);
    this.blocks(last, 0, last.length);
    return Array.from(this.state, (word) => (word >>> 0).toString(16).padStart(8, '0')).join('');
  }

  blocks(bytes, from, to) {
    const view = new DataView(bytes.buffer, bytes.byteOffset);
    for (let at = from; at < to; at += 64) this.block(view, at);
  }

  block(view, at) {
    const w = this.schedule;
    for (let i = 0; i < 16; i += 1) w[i] = view.getInt32(at + 4 * i);
    for (let i = 16; i < 64; i += 1) {
      const [x, y] = [w[i - 15], w[i - 2]];
      const s0 = ((x >>> 7) | (x << 25)) ^ ((x >>> 18) | (x << 14)) ^ (x >>> 3);
      const s1 = ((y >>> 17) | (y << 15)) ^ ((y >>> 19) | (y << 13)) ^ (y >>> 10);
      w[i] = (w[i - 16] + s0 + w[i - 7] + s1) | 0;
    }
    let [a, b, c, d, e, f, g, h] = this.state;
    for (let i = 0; i < 64; i += 1) {
      const s1 = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7));
      const t1 = (h + s1 + ((e & f) ^ (~e & g)) + K[i] + w[i]) | 0;
      const s0 = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10));
      const t2 = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0;
      h = g; g = f; f = e; e = (d + t1) | 0; d = c; c = b; b = a; a = (t1 + t2) | 0;
    }
    const add = [a, b, c, d, e, f, g, h];
    for (let i = 0; i < 8; i += 1) this.state[i] = (this.state[i] + add[i]) | 0;
  }
}

function joined(first, second) {
  const all = new Uint8Array(first.length + second.length);
  all.set(first);
  all.set(second, first.length);
  return all;
}

/** The first 32 bits of the fractions of the cube roots of the first 64 primes. */
function roundConstants() {
  const primes = [];
  for (let n = 2; primes.length < 64; n += 1) if (primes.every((p) => n % p)) primes.push(n);
  return Int32Array.from(primes, (p) => Math.floor((Math.cbrt(p) % 1) * 2 ** 32) | 0);
}
