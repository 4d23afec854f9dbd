// Numbers and names as people read them.

/** A number with `digits` significant digits; very small and very large ones in scientific notation. */
export function number(value, digits = 4) {
  if (typeof value !== 'number' || !Number.isFinite(value)) return '–';
  if (value === 0) return '0';
  const size = Math.abs(value);
  if (Number.isInteger(value) && size < 1e9) return value.toLocaleString('en');
  if (size < 1e-3 || size >= 1e6) return value.toExponential(digits - 1).replace('-', '−').replace('e+', 'e').replace('e-', 'e−');
  return signed(Number(value.toPrecision(digits)).toString());
}

/** Fixed decimals in an even column, for matrices. */
export function fixed(value, decimals = 5) {
  if (!Number.isFinite(value)) return '–';
  const text = value.toFixed(decimals);
  return Number(text) === 0 ? text.replace('-', '') : signed(text);
}

export function percent(share, decimals = 1) {
  return Number.isFinite(share) ? `${(share * 100).toFixed(decimals)} %` : '–';
}

/** A probability and the level that it reaches; results of earlier versions tell none. */
export function sure(probability, level) {
  const told = level === undefined ? '' : `, ${level ?? 'below both levels'}`;
  return `${percent(probability)}${told}`;
}

export function seconds(value) {
  if (!Number.isFinite(value)) return '–';
  if (value < 1) return `${Math.round(value * 1000)} ms`;
  if (value < 120) return `${value.toFixed(value < 10 ? 2 : 1)} s`;
  return `${Math.floor(value / 60)} min ${Math.round(value % 60)} s`;
}

export function bytes(count) {
  if (!Number.isFinite(count)) return '';
  const units = ['B', 'KiB', 'MiB', 'GiB'];
  let step = 0;
  let size = count;
  while (size >= 1024 && step < units.length - 1) {
    size /= 1024;
    step += 1;
  }
  return `${step === 0 ? size : size.toFixed(1)} ${units[step]}`;
}

/** LOW_OVERLAP or residual_rms as words: "Low overlap", "Residual rms". */
export function words(name) {
  const text = String(name ?? '').replaceAll('_', ' ').trim().toLowerCase();
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** A moment, given as RFC 3339, in the reader's own time zone. */
export function moment(value) {
  if (!value) return '';
  const date = new Date(value);
  return Number.isNaN(date.getTime()) ? '' : date.toLocaleString();
}

const signed = (text) => text.replace('-', '−');
