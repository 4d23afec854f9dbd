// The names of the files in an archive, without unpacking it; and a folder as an archive.

const END_OF_DIRECTORY = 0x06054b50;
const DIRECTORY_ENTRY = 0x02014b50;
const END_BYTES = 66_000; // the end record and the longest comment behind it
const MOST_BYTES = 4 << 20; // of a packed archive, which has no directory: its first names must do
const MOST_NAMES = 5000;
const BLOCK = 512;

/** The names in a zip or tar archive, also in one packed by gzip, as far as they are found quickly; [] of other files. */
export async function namesIn(file) {
  const head = new Uint8Array(await file.slice(0, BLOCK).arrayBuffer());
  if (head[0] === 0x50 && head[1] === 0x4b && head[2] === 3) return namesInZip(file);
  if (isTar(head)) return namesInTar(file);
  if (head[0] === 0x1f && head[1] === 0x8b) return namesInTar(await unpacked(file));
  return [];
}

async function namesInZip(file) {
  const from = Math.max(0, file.size - END_BYTES);
  const end = new DataView(await file.slice(from).arrayBuffer());
  let at = end.byteLength - 22;
  while (at >= 0 && end.getUint32(at, true) !== END_OF_DIRECTORY) at -= 1;
  if (at < 0) return [];
  const start = end.getUint32(at + 16, true);
  const directory = new DataView(await file.slice(start, start + end.getUint32(at + 12, true)).arrayBuffer());
  const names = [];
  for (let i = 0; i + 46 <= directory.byteLength && names.length < MOST_NAMES;) {
    if (directory.getUint32(i, true) !== DIRECTORY_ENTRY) break;
    const length = directory.getUint16(i + 28, true);
    names.push(text(new Uint8Array(directory.buffer, i + 46, Math.min(length, directory.byteLength - i - 46))));
    i += 46 + length + directory.getUint16(i + 30, true) + directory.getUint16(i + 32, true);
  }
  return names;
}

async function namesInTar(file) {
  const names = [];
  for (let at = 0; at + BLOCK <= file.size && names.length < MOST_NAMES;) {
    const head = new Uint8Array(await file.slice(at, at + BLOCK).arrayBuffer());
    if (!isTar(head)) break;
    names.push(text(head.subarray(0, 100)));
    const size = Number.parseInt(text(head.subarray(124, 136)), 8) || 0;
    at += BLOCK * (1 + Math.ceil(size / BLOCK));
  }
  return names;
}

const isTar = (head) => head.length === BLOCK && text(head.subarray(257, 262)) === 'ustar';

/** The beginning of what a gzip file holds. */
async function unpacked(file) {
  const reader = file.stream().pipeThrough(new DecompressionStream('gzip')).getReader();
  const parts = [];
  let size = 0;
  try {
    while (size < MOST_BYTES) {
      const { value, done } = await reader.read();
      if (done) break;
      parts.push(value);
      size += value.length;
    }
  } catch {
    // damaged: the service says so
  }
  reader.cancel().catch(() => {});
  return new Blob(parts);
}

/** Files as one tar archive, in the order of their paths, whose bytes are read only as they are sent. */
export function archiveOf(name, files) {
  const parts = [];
  for (const { path, file } of [...files].sort((a, b) => (a.path < b.path ? -1 : 1))) {
    parts.push(headerOf(path, file.size), file, new Uint8Array(-file.size & (BLOCK - 1)));
  }
  return new File([...parts, new Uint8Array(2 * BLOCK)], name);
}

/** A tar header (POSIX ustar). Without times and owners: the same files are the same archive. */
function headerOf(path, size) {
  const head = new Uint8Array(BLOCK);
  const write = (at, words) => head.set(new TextEncoder().encode(words), at);
  const cut = path.length > 100 ? path.lastIndexOf('/', 155) : -1;
  write(0, path.slice(cut + 1).slice(-100));
  write(100, '0000644\0');
  write(124, `${size.toString(8).padStart(11, '0')}\0`);
  write(136, '00000000000\0');
  write(148, '        ');
  write(156, '0');
  write(257, 'ustar\x0000');
  if (cut > 0) write(345, path.slice(0, cut));
  write(148, `${head.reduce((sum, byte) => sum + byte, 0).toString(8).padStart(6, '0')}\0 `);
  return head;
}

const text = (bytes) => new TextDecoder().decode(bytes).replace(/\0.*$/s, '');
