// A file of `ssrvlad export`, run by onnxruntime-web on the CPU.

import * as ort from "./node_modules/onnxruntime-web/dist/ort.wasm.min.mjs";
import { inflated } from "./label_png.js";
import { metadataOf, skeletonTensor, withOutput } from "./onnx_file.js";

ort.env.wasm.numThreads = 1;

const FORMAT = "2";
const TOLERANCE = 1e-6;
const MOST_OTHER_PIXELS = 0.01;
const LEAST_COSINE = 0.8;
const MOST_GOLDEN = 1 << 26;
const PIXELS_OF_WORD = 3;
const ARRAYS = {
  uint8: Uint8Array,
  int32: Int32Array,
  int64: BigInt64Array,
  float32: Float32Array,
};

export class Model {
  /**
   * The model in the bytes of a file. It runs its golden pair, and is refused where this runtime
   * gives something else, unless `check` is false.
   */
  static async load(file, check = true) {
    const metadata = metadataOf(file);
    for (const name of ["fingerprint", "config", "label_space", "golden", "interface"])
      if (!metadata[name]) throw new Error(`no metadata ssrvlad.${name}: no file of ssrvlad export`);
    const { format = "1" } = metadata;
    if (format !== FORMAT)
      throw new Error(`a file of format ${format}; expected ${FORMAT}: export it again`);
    if (JSON.parse(metadata.interface).sweep?.length)
      throw new Error("expected a file without --sweep: this page takes one descriptor an image");
    const skeleton = skeletonTensor(file);
    const bytes = skeleton ? withOutput(file, skeleton) : file;
    const session = await ort.InferenceSession.create(bytes, { logSeverityLevel: 3 });
    const model = new Model(session, metadata, skeleton);
    if (check) {
      model.checked = await model.runGoldenPair();
      if (!model.checked.holds)
        throw new Error(`computed wrong in this browser: ${model.checked.text}; ?unchecked runs it`);
    }
    return model;
  }

  constructor(session, metadata, skeleton) {
    this.session = session;
    this.skeleton = skeleton;
    this.fingerprint = metadata.fingerprint;
    this.config = JSON.parse(metadata.config);
    this.space = JSON.parse(metadata.label_space);
    this.golden = JSON.parse(metadata.golden);
    [this.input] = session.inputNames;
    ({ dtype: this.dtype, shape: this.shape = [] } = JSON.parse(metadata.interface).inputs[this.input] ?? {});
  }

  /** Whether the file takes photographs: it is one of `ssrvlad fuse`. */
  get takesPhotos() {
    return this.input === "image";
  }

  /** Of a photograph, RGB bytes: what `describe` gives, and the `labels` that the network saw. */
  async describePhoto({ pixels, height, width }) {
    const found = await this.#run(new ort.Tensor("uint8", pixels, [1, height, width, 3]));
    return this.#described(found, height, width);
  }

  /** Of an image of ids: descriptor and, if the file makes one, `skeleton`, see `unpackedSkeleton`. */
  async describe({ labels, height, width }) {
    if (this.input !== "labels") throw new Error("label maps need a file of --input labels");
    const shape = [1, height, width];
    if (this.shape.some((length, axis) => Number.isInteger(length) && length !== shape[axis]))
      throw new Error(`the file takes label maps of (${this.shape.join(", ")}), got (${shape.join(", ")})`);
    const ids = this.dtype === "int64" ? BigInt64Array.from(labels, BigInt) : ARRAYS[this.dtype].from(labels);
    if (this.dtype === "uint8" && labels.some((id) => id > 255))
      throw new Error("the file takes ids up to 255");
    const found = await this.#run(new ort.Tensor(this.dtype, ids, shape));
    return this.#described(found, height, width);
  }

  #described(found, height, width) {
    if (found.unknown[0])
      throw new Error(`${found.unknown[0]} pixels have an id outside label space ${this.space.name}`);
    if (!found.descriptor.every(Number.isFinite))
      throw new Error("the picture is too wide, or has too many keypoints, for such a file");
    const grid = workingGrid(this.config.working_size, height, width);
    return { ...found, ...grid, skeleton: found.skeleton && unpackedSkeleton(found.skeleton, grid) };
  }

  /**
   * How the golden pair comes out: ``{holds, difference, text}``. Where the network labels some
   * pixels of a golden image otherwise, the descriptor is another too, and only a gross fault of
   * the head shows.
   */
  async runGoldenPair() {
    const given = await this.#array(this.input);
    const found = await this.#run(new ort.Tensor(given.dtype, given.values, given.shape));
    const expected = {};
    for (const name of Object.keys(this.golden))
      if (name !== this.input) expected[name] = (await this.#array(name)).values;
    const other = expected.labels ? fractionOfOthers(found.labels, expected.labels) : 0;
    const counts = Object.keys(expected).filter((name) => name !== "descriptor" && name !== "labels");
    const difference = counts.some((name) => largestDifference(found[name], expected[name]))
      ? Infinity
      : largestDifference(found.descriptor, expected.descriptor);
    const images = expected.unknown.length;
    const roughly = other > 0 && leastCosine(found.descriptor, expected.descriptor, images) >= LEAST_COSINE;
    return {
      holds: other <= MOST_OTHER_PIXELS && (difference <= TOLERANCE || roughly),
      difference,
      text:
        `golden pair: largest difference ${difference.toExponential(2)}` +
        (other ? `, ${(100 * other).toFixed(2)} % of the labels differ` : ""),
    };
  }

  async #run(input) {
    const { descriptor, ...others } = await this.session.run({ [this.input]: input });
    const skeleton = this.skeleton && others[this.skeleton].data;
    const counts = Object.entries(others).map(([name, { data }]) => [name, Array.from(data, Number)]);
    return { ...Object.fromEntries(counts), descriptor: descriptor.data, skeleton };
  }

  async #array(name) {
    const entry = this.golden[name];
    if (!entry) throw new Error(`the golden pair has no ${name}; see ssrvlad verify`);
    const Values = ARRAYS[entry.dtype];
    const size = entry.shape.reduce((product, axis) => product * axis, Values?.BYTES_PER_ELEMENT);
    if (!(size >= 0 && size <= MOST_GOLDEN)) throw new Error(`golden ${name}: expected at most 64 MiB`);
    const bytes = Uint8Array.from(atob(entry.data), (letter) => letter.charCodeAt(0));
    const { buffer } = await inflated([bytes], size);
    return { ...entry, values: new Values(buffer) };
  }
}

function largestDifference(found, wanted) {
  if (found.length !== wanted.length) return Infinity;
  let most = 0;
  for (let at = 0; at < wanted.length; at++) {
    const step = Math.abs(found[at] - Number(wanted[at]));
    if (!(step <= most)) most = Number.isNaN(step) ? Infinity : step;
  }
  return most;
}

function fractionOfOthers(found, wanted) {
  if (found.length !== wanted.length) return 1;
  let count = 0;
  for (let at = 0; at < wanted.length; at++) count += found[at] !== Number(wanted[at]);
  return count / wanted.length;
}

/** Of the descriptors of several images, both of length 1. */
function leastCosine(found, wanted, images) {
  const length = wanted.length / images;
  const cosines = Array.from({ length: images }, (_, image) => {
    let sum = 0;
    for (let at = image * length; at < (image + 1) * length; at++) sum += found[at] * wanted[at];
    return sum;
  });
  return Math.min(...cosines);
}

/** The rule of `SSRVLADConfig.grid`. */
function workingGrid(size, height, width) {
  const shorter = Math.min(height, width);
  if (size === null || size >= shorter) return { rows: height, columns: width };
  const rounded = (side) => Math.floor((2 * side * size + shorter) / (2 * shorter));
  return { rows: rounded(height), columns: rounded(width) };
}

/**
 * ``rows * columns`` bytes, bit k is layer k. In the graph a row is ``pitch`` words of three pixels,
 * int32, and the line begins with a margin of ``pitch + 1`` words.
 */
function unpackedSkeleton(line, { rows, columns }) {
  const pitch = Math.floor(columns / PIXELS_OF_WORD) + 1;
  if (line.length < (rows + 1) * pitch + 2 * (pitch + 1))
    throw new Error("the skeleton in the graph is of another layout");
  const bytes = new Uint8Array(line.buffer, line.byteOffset, line.byteLength);
  return Uint8Array.from({ length: rows * columns }, (_, at) => {
    const [y, x] = [Math.floor(at / columns), at % columns];
    const word = pitch + 1 + y * pitch + Math.floor(x / PIXELS_OF_WORD);
    return bytes[4 * word + (x % PIXELS_OF_WORD)];
  });
}
