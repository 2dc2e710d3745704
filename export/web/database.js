// Channels of reference frames from `ssrvlad db export --format npy`.

const TRUST = { descriptor: 1, features: 6, hog: 2 }; // how `ssrvlad query` weighs channels of single frames
const REACH = 2; // columns of cells by which features are moved to each side

const ONES = Uint8Array.from({ length: 256 }, (_, byte) => byte.toString(2).replaceAll("0", "").length);
const decoder = new TextDecoder();

/** The number of bits that differ between two parts of arrays of bytes. */
export function differentBits(one, other, size, begin = 0, otherBegin = 0) {
  let count = 0;
  for (let at = 0; at < size; at++) count += ONES[one[begin + at] ^ other[otherBegin + at]];
  return count;
}

export class Database {
  /**
   * From the ids of the frames and, by the name of the channel, ``{bytes, fingerprint}`` of the arrays:
   * `descriptor`, and `features` and `hog` where there are some. A fingerprint may be undefined.
   */
  constructor(frames, channels) {
    this.frames = frames.split("\n").slice(0, -1);
    this.channels = {};
    for (const [name, { bytes, fingerprint }] of Object.entries(channels)) {
      const array = name === "features" ? readArray(bytes, "|u1", 4) : readArray(bytes, "<f4", 2);
      if (array.shape[0] !== this.frames.length)
        throw new Error(`${name}: the array has ${array.shape[0]} rows, the text file ${this.frames.length} ids`);
      this.channels[name] = { ...array, fingerprint: fingerprint?.trim() };
    }
  }

  /**
   * ``[{frame, score}]``, highest first: cosines (Eq. 4), or with several channels, here and of the
   * query, fused scores. A zero vector matches nothing.
   */
  search(described, top) {
    const names = Object.keys(this.channels).filter((name) => described[name]);
    const scores = names.map((name) => {
      const { shape, rows } = this.channels[name];
      const query = described[name];
      const length = shape.slice(1).reduce((product, axis) => product * axis, 1);
      if (query.length !== length)
        throw new Error(`expected a database of ${query.length} numbers a frame, got ${length}`);
      if (name === "features") return rows.map((row) => cosineOfSigns(query, row, shape[1]));
      const norm = Math.sqrt(product(query, query));
      return rows.map((row) => product(query, row) / norm / Math.sqrt(product(row, row)));
    });
    return (names.length > 1 ? fused(scores, names.map((name) => TRUST[name])) : scores[0])
      .map((score, at) => ({ frame: this.frames[at], score }))
      .filter(({ score }) => !Number.isNaN(score))
      .sort((a, b) => b.score - a.score)
      .slice(0, top);
  }
}

function product(a, b) {
  let sum = 0;
  for (let at = 0; at < a.length; at++) sum += a[at] * b[at];
  return sum;
}

/** The cosine of signs over the columns of cells that overlap, for the best of all moves. */
function cosineOfSigns(query, row, columns) {
  const column = row.length / columns;
  let best = -1;
  for (let move = -REACH; move <= REACH; move++) {
    const [ours, theirs] = [Math.max(0, -move) * column, Math.max(0, move) * column];
    const size = (columns - Math.abs(move)) * column;
    best = Math.max(best, 1 - differentBits(query, row, size, ours, theirs) / (4 * size));
  }
  return best;
}

/**
 * The scores of one query by several channels as one, by the rule of `ssrvlad query`: the weighted
 * means of their z-scores of nearness, minus the logarithm of 1 - cosine. NaN where there is none.
 */
function fused(channels, trust) {
  const whole = trust.reduce((sum, value) => sum + value, 0);
  const scaled = channels.map((scores) => {
    const near = scores.map((score) => -Math.log(Math.max(1 - score, 1e-6)));
    const known = near.filter((value) => !Number.isNaN(value));
    const meanOf = (values) => values.reduce((sum, value) => sum + value, 0) / Math.max(1, known.length);
    const mean = meanOf(known);
    const spread = Math.sqrt(meanOf(known.map((value) => (value - mean) ** 2)));
    return { near, mean, spread };
  });
  const weighted = (value) => scaled.reduce((sum, each, at) => sum + (trust[at] / whole) * value(each), 0);
  const [mean, spread] = [weighted((each) => each.mean), weighted((each) => each.spread)];
  return channels[0].map((_, row) => {
    if (channels.every((scores) => Number.isNaN(scores[row]))) return NaN;
    const z = weighted((each) => ((each.near[row] - each.mean) || 0) / Math.max(each.spread, 1e-6));
    return -Math.expm1(-(mean + spread * z));
  });
}

/** ``{shape, rows}`` of a ``.npy`` file of a type and a number of axes. */
function readArray(file, type, axes) {
  const view = new DataView(file.buffer, file.byteOffset, file.byteLength);
  if (decoder.decode(file.subarray(1, 6)) !== "NUMPY") throw new Error("expected a .npy file");
  const [begin, length] = file[6] > 1 ? [12, view.getUint32(8, true)] : [10, view.getUint16(8, true)];
  const header = decoder.decode(file.subarray(begin, begin + length));
  const shape = /'shape': \(([\d, ]+)\)/.exec(header)?.[1].split(", ").map(Number) ?? [];
  if (!header.includes(`'${type}'`) || !header.includes("False") || shape.length !== axes)
    throw new Error(`expected an array of ${axes} axes of ${type} in C order`);
  const content = file.slice(begin + length);
  const size = shape.slice(1).reduce((product, axis) => product * axis, 1);
  const isBytes = type === "|u1";
  if (content.length !== shape[0] * size * (isBytes ? 1 : 4)) throw new Error("the .npy file is cut short");
  const values = isBytes ? content : new Float32Array(content.buffer);
  const rows = Array.from({ length: shape[0] }, (_, row) => values.subarray(row * size, (row + 1) * size));
  return { shape, rows };
}
