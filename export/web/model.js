// A file of `ssrvlad export` or `ssrvlad fuse`, run by onnxruntime-web on the CPU.

import * as ort from "./node_modules/onnxruntime-web/dist/ort.wasm.min.mjs";
import { inflated } from "./label_png.js";
import { metadataOf } from "./onnx_file.js";

ort.env.wasm.numThreads = 1;

const FORMAT = "2";
const TOLERANCE = 1e-6;
const MAX_OTHER_PIXELS = 0.01;
const MAX_OTHER_SIGNS = 0.01;
const MIN_COSINE = 0.8;
const MAX_GOLDEN_BYTES = 1 << 26;
const ARRAYS = {
  uint8: Uint8Array,
  int32: Int32Array,
  int64: BigInt64Array,
  float32: Float32Array,
};

export class Model {
  /**
   * Loads the model in the bytes of a file. Runs its golden pair and refuses the file if this
   * runtime gives other outputs, unless `check` is false.
   */
  static async load(file, check = true) {
    const metadata = metadataOf(file);
    for (const name of ["fingerprint", "config", "label_space", "golden", "interface"])
      if (!metadata[name]) throw new Error(`no metadata ssrvlad.${name}: not a file of ssrvlad export`);
    const { format = "1" } = metadata;
    if (format !== FORMAT)
      throw new Error(`a file of format ${format}; expected ${FORMAT}: export it again`);
    const session = await ort.InferenceSession.create(file, { logSeverityLevel: 3 });
    const model = new Model(session, metadata);
    if (check) {
      model.checked = await model.runGoldenPair();
      if (!model.checked.holds)
        throw new Error(`computed wrong in this browser: ${model.checked.text}; ?unchecked runs it`);
    }
    return model;
  }

  constructor(session, metadata) {
    this.session = session;
    this.fingerprint = metadata.fingerprint;
    /** Fingerprints of the channels that the file gives, by name. */
    this.channels = { descriptor: metadata.fingerprint, features: metadata.features, hog: metadata.hog };
    this.config = JSON.parse(metadata.config);
    this.space = JSON.parse(metadata.label_space);
    this.golden = JSON.parse(metadata.golden);
    [this.input] = session.inputNames;
    const { inputs, sweep = [] } = JSON.parse(metadata.interface);
    ({ dtype: this.dtype, shape: this.shape = [] } = inputs[this.input] ?? {});
    /** Columns of the anchors of a descriptor; none of a single one. */
    this.columns = sweep;
  }

  /** Whether the file takes photographs, as files of `ssrvlad fuse` do. */
  get takesPhotos() {
    return this.input === "image";
  }

  /** The result of `describe` for a photograph of RGB bytes, and the `labels` of the network. */
  async describePhoto({ pixels, height, width }) {
    const outputs = await this.#run(new ort.Tensor("uint8", pixels, [1, height, width, 3]));
    return this.#described(outputs);
  }

  /** Of a label map: `descriptor`, that of all anchors if there are several, and `usual`, that of the usual
   * anchor. */
  async describe({ labels, height, width }) {
    if (this.input !== "labels") throw new Error("label maps need a file of --input labels");
    const shape = [1, height, width];
    if (this.shape.some((length, axis) => Number.isInteger(length) && length !== shape[axis]))
      throw new Error(`the file takes label maps of (${this.shape.join(", ")}), got (${shape.join(", ")})`);
    const ids = this.dtype === "int64" ? BigInt64Array.from(labels, BigInt) : ARRAYS[this.dtype].from(labels);
    if (this.dtype === "uint8" && labels.some((id) => id > 255))
      throw new Error("the file takes ids up to 255");
    return this.#described(await this.#run(new ort.Tensor(this.dtype, ids, shape)));
  }

  #described(outputs) {
    const { unknown, descriptor, features, hog = [] } = outputs;
    if (unknown[0])
      throw new Error(`${unknown[0]} pixels have an id outside label space ${this.space.name}`);
    if (!descriptor.every(Number.isFinite))
      throw new Error("the picture is too wide, or has too many keypoints, for an exported file");
    if (features && !features.some((signs) => signs))
      throw new Error("the activations of the network are not finite, or the same everywhere");
    if (!hog.every(Number.isFinite)) throw new Error("the HOG of the picture is not finite");
    const length = descriptor.length / (this.columns.length || 1);
    const middle = (descriptor.length - length) / 2;
    return { ...outputs, usual: descriptor.subarray(middle, middle + length) };
  }

  /**
   * Runs the golden pair: ``{holds, difference, text}``. Where some labels of a golden image
   * differ, the descriptor differs too, so only a large error of the head is found.
   */
  async runGoldenPair() {
    const input = await this.#array(this.input);
    const outputs = await this.#run(new ort.Tensor(input.dtype, input.values, input.shape));
    const expected = {};
    for (const name of Object.keys(this.golden))
      if (name !== this.input) expected[name] = (await this.#array(name)).values;
    const other = expected.labels ? fractionOfOthers(outputs.labels, expected.labels) : 0;
    const signs = expected.features ? fractionOfOtherBits(outputs.features, expected.features) : 0;
    const hog = expected.hog ? largestDifference(outputs.hog, expected.hog) : 0;
    const near = ["descriptor", "labels", "features", "hog"];
    const counts = Object.keys(expected).filter((name) => !near.includes(name));
    const difference = counts.some((name) => largestDifference(outputs[name], expected[name]))
      ? Infinity
      : largestDifference(outputs.descriptor, expected.descriptor);
    const images = expected.unknown.length;
    const cosine = smallestCosine(outputs.descriptor, expected.descriptor, images);
    const isSimilar = other > 0 && cosine >= MIN_COSINE;
    return {
      holds:
        other <= MAX_OTHER_PIXELS &&
        signs <= MAX_OTHER_SIGNS &&
        hog <= TOLERANCE &&
        (difference <= TOLERANCE || isSimilar),
      difference,
      text:
        `golden pair: largest difference ${difference.toExponential(2)}` +
        (other ? `, ${(100 * other).toFixed(2)} % of the labels differ` : "") +
        (signs ? `, ${(100 * signs).toFixed(2)} % of the features differ` : "") +
        (hog > TOLERANCE ? `, HOG by ${hog.toExponential(2)}` : ""),
    };
  }

  async #run(input) {
    const outputs = Object.entries(await this.session.run({ [this.input]: input }));
    const numbers = (data) => (data instanceof BigInt64Array ? Array.from(data, Number) : data);
    return Object.fromEntries(outputs.map(([name, { data }]) => [name, numbers(data)]));
  }

  async #array(name) {
    const entry = this.golden[name];
    if (!entry) throw new Error(`the golden pair has no ${name}; see ssrvlad verify`);
    const Values = ARRAYS[entry.dtype];
    const size = entry.shape.reduce((product, axis) => product * axis, Values?.BYTES_PER_ELEMENT);
    if (!(size >= 0 && size <= MAX_GOLDEN_BYTES)) throw new Error(`golden ${name}: expected at most 64 MiB`);
    const bytes = Uint8Array.from(atob(entry.data), (letter) => letter.charCodeAt(0));
    const { buffer } = await inflated([bytes], size);
    return { ...entry, values: new Values(buffer) };
  }
}

function largestDifference(got, expected) {
  if (got.length !== expected.length) return Infinity;
  let largest = 0;
  for (let at = 0; at < expected.length; at++) {
    const step = Math.abs(got[at] - Number(expected[at]));
    if (!(step <= largest)) largest = Number.isNaN(step) ? Infinity : step;
  }
  return largest;
}

function fractionOfOthers(got, expected) {
  if (got.length !== expected.length) return 1;
  let count = 0;
  for (let at = 0; at < expected.length; at++) count += got[at] !== Number(expected[at]);
  return count / expected.length;
}

function fractionOfOtherBits(got, expected) {
  const MASKS = [1, 2, 4, 8, 16, 32, 64, 128];
  const bits = (bytes) => Array.from(bytes, (byte) => MASKS.map((mask) => byte & mask)).flat();
  return fractionOfOthers(bits(got), bits(expected));
}

/** The smallest cosine of several images; descriptors have length 1. */
function smallestCosine(got, expected, images) {
  const length = expected.length / images;
  const cosines = Array.from({ length: images }, (_, image) => {
    let sum = 0;
    for (let at = image * length; at < (image + 1) * length; at++) sum += got[at] * expected[at];
    return sum;
  });
  return Math.min(...cosines);
}
