// Reading numpy's .npz: a zip archive of .npy arrays. Only what numpy writes is understood.

const END_OF_DIRECTORY = 0x06054b50;
const DIRECTORY_ENTRY = 0x02014b50;
const STORED = 0;
const DEFLATED = 8;
const ARRAYS = { f4: Float32Array, f8: Float64Array, i4: Int32Array, i8: BigInt64Array, u1: Uint8Array, b1: Uint8Array };

/** The arrays of the archive by name: { name: { data, shape } }. Raises Error on anything else. */
export async function readNpz(buffer) {
  const view = new DataView(buffer);
  const end = findEnd(view);
  const arrays = {};
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left -= 1) {
    if (view.getUint32(at, true) !== DIRECTORY_ENTRY) throw new Error('the archive is damaged');
    const entry = {
      method: view.getUint16(at + 10, true),
      packed: view.getUint32(at + 20, true),
      offset: view.getUint32(at + 42, true),
    };
    const nameLength = view.getUint16(at + 28, true);
    const name = new TextDecoder().decode(new Uint8Array(buffer, at + 46, nameLength));
    arrays[name.replace(/\.npy$/, '')] = readNpy(await unpack(buffer, view, entry));
    at += 46 + nameLength + view.getUint16(at + 30, true) + view.getUint16(at + 32, true);
  }
  return arrays;
}

function findEnd(view) {
  for (let at = view.byteLength - 22; at >= 0; at -= 1) {
    if (view.getUint32(at, true) === END_OF_DIRECTORY) return at;
  }
  throw new Error('this is not a zip archive');
}

async function unpack(buffer, view, { method, packed, offset }) {
  // The lengths in front of the data may be placeholders; the directory's are the true ones.
  const start = offset + 30 + view.getUint16(offset + 26, true) + view.getUint16(offset + 28, true);
  const bytes = buffer.slice(start, start + packed);
  if (method === STORED) return bytes;
  if (method !== DEFLATED) throw new Error('the compression of the archive is unknown');
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate-raw'))).arrayBuffer();
}

function readNpy(buffer) {
  const view = new DataView(buffer);
  const wide = view.getUint8(6) > 1; // version 2 has a four-byte header length
  const start = wide ? 12 : 10;
  const length = wide ? view.getUint32(8, true) : view.getUint16(8, true);
  const header = new TextDecoder().decode(new Uint8Array(buffer, start, length));
  const type = /'descr':\s*'[<|]([a-z]\d)'/.exec(header)?.[1];
  const shape = /'shape':\s*\(([^)]*)\)/.exec(header)?.[1].split(',').map((part) => part.trim()).filter(Boolean).map(Number);
  if (!ARRAYS[type] || !shape || /'fortran_order':\s*True/.test(header)) throw new Error('an array has an unknown type');
  return { data: new ARRAYS[type](buffer.slice(start + length)), shape };
}
