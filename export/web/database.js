// Descriptors of reference frames from `ssrvlad db export --format npy`.

const decoder = new TextDecoder();

export class Database {
  /** From the bytes of the array and the text files beside it; `fingerprint` may be undefined. */
  constructor(array, frames, fingerprint) {
    const { shape, values } = readArray(array);
    this.length = shape[1];
    this.rows = Array.from({ length: shape[0] }, (_, row) =>
      values.subarray(row * shape[1], (row + 1) * shape[1]),
    );
    this.frames = frames.split("\n").slice(0, -1);
    this.fingerprint = fingerprint?.trim();
    if (this.frames.length !== shape[0])
      throw new Error(`the array has ${shape[0]} rows, the text file ${this.frames.length} ids`);
  }

  /** ``[{frame, score}]``, highest cosines (Eq. 4) first. A zero vector matches nothing. */
  search(query, top) {
    if (query.length !== this.length)
      throw new Error(`expected a database of ${query.length} numbers a frame, got ${this.length}`);
    const norm = Math.sqrt(product(query, query));
    return this.rows
      .map((row, at) => ({
        frame: this.frames[at],
        score: product(query, row) / norm / Math.sqrt(product(row, row)),
      }))
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

function readArray(file) {
  const view = new DataView(file.buffer, file.byteOffset, file.byteLength);
  if (decoder.decode(file.subarray(1, 6)) !== "NUMPY") throw new Error("expected a .npy file");
  const [begin, length] = file[6] > 1 ? [12, view.getUint32(8, true)] : [10, view.getUint16(8, true)];
  const header = decoder.decode(file.subarray(begin, begin + length));
  const [, shape] = /'shape': \((\d+, \d+)\)/.exec(header) ?? [];
  if (!header.includes("'<f4'") || !header.includes("False") || !shape)
    throw new Error("expected an (R, D) float32 array in C order");
  const sizes = shape.split(", ").map(Number);
  const content = file.slice(begin + length);
  if (content.length !== sizes[0] * sizes[1] * 4) throw new Error("the .npy file is cut short");
  return { shape: sizes, values: new Float32Array(content.buffer) };
}
