// A map: channels of reference frames from `ssrvlad db export --format npy`, and what the core finds there.

import { ADDRESS, DOUBLE, INT, INTERFACE, LONG, Struct } from "./core.js";

// of ssrvlad_map.h
const [ALONE, OFFLINE] = [0, 2];
const [VECTORS, SIGNS] = [0, 1];
const DRIVES = new Struct({ starts: ADDRESS, count: LONG, rows: LONG });
const CHANNEL = new Struct({
  ...{ rows: ADDRESS, kind: INT, columns: LONG, height: LONG, size: LONG, trust: DOUBLE, means: ADDRESS },
});
const QUERIES = new Struct({ descriptors: ADDRESS, anchors: LONG });
const STEPS = new Struct({
  ...{ standardise: INT, sweep: INT, follow: INT, delay: LONG, top: LONG },
  ...{ allowed: ADDRESS, excluded: ADDRESS },
});
const TAKEN = new Struct({ standardised: INT, width: LONG, weights: ADDRESS });
const DECISION = new Struct({
  ...{ scores: ADDRESS, rows: ADDRESS, right: ADDRESS, spread: ADDRESS, together: ADDRESS },
  ...{ followed: INT, way: INT, streams: LONG, rate: DOUBLE, gain: DOUBLE, follows: ADDRESS },
});

/** By name: the name in `ssrvlad query`, how much it counts before anything is known, and its array. */
const CHANNELS = {
  descriptor: { title: "ssr-vlad", trust: 1, type: "<f4", axes: 2 },
  features: { title: "features", trust: 6, type: "|u1", axes: 4 },
  hog: { title: "hog", trust: 2, type: "<f4", axes: 2 },
};

const decoder = new TextDecoder();

export class Database {
  /**
   * From the ids of the frames and, by the name of the channel, ``{bytes, fingerprint}`` of the arrays:
   * `descriptor`, and `features` and `hog` where there are some. A fingerprint may be undefined. The
   * arrays are in the memory of the core until `free`.
   */
  constructor(core, frames, channels) {
    this.core = core;
    this.frames = frames.split(/\r?\n/);
    if (!this.frames.at(-1)) this.frames.pop();
    if (!this.frames.length) throw new Error("expected a database of frames, got an empty one");
    const arrays = Object.entries(channels).map(([name, { bytes, fingerprint }]) => {
      const { shape: [count, ...form], values } = readArray(bytes, name);
      if (count !== this.frames.length)
        throw new Error(`${name}: the array has ${count} rows, the text file ${this.frames.length} ids`);
      const [columns, height, size] = form.length > 1 ? form : [1, 1, ...form];
      return [name, { columns, height, size, values, fingerprint: fingerprint?.trim() }];
    });
    this.channels = {};
    try {
      for (const [name, { values, ...others }] of arrays)
        this.channels[name] = { ...others, rows: core.put(values) };
    } catch (error) {
      this.free();
      throw error;
    }
  }

  free() {
    for (const { rows } of Object.values(this.channels)) this.core.free(rows);
  }

  /**
   * Finds the frames of a drive as `ssrvlad query` does, or one frame as `ssrvlad locate`.
   *
   * `drive` has the arrays of each frame by the names of channels, those of `descriptor` from all
   * `columns`, if there are some. Returns of each frame ``{candidates, confidence}``: the best,
   * ``[{frame, score}]``, and the probability that the first is right; and the `steps` that were taken.
   */
  query(drive, columns, top) {
    const [{ core }, count] = [this, drive.length];
    const names = Object.keys(this.channels).filter((name) => drive[0][name]);
    const follow = count > 1 ? OFFLINE : ALONE;
    return core.using(({ room, put }) => {
      const [scores, rows] = [room(4 * count * top), room(8 * count * top)];
      const [right, spread, together] = [1, 2, 3].map(() => room(4 * count));
      const weights = room(8 * names.length);
      const [decision, taken] = [
        put(DECISION.bytes({ scores, rows, right, spread, together })),
        put(TAKEN.bytes({ weights })),
      ];
      const queries = this.#queries(put, names, drive, columns);
      const steps = put(STEPS.bytes({ standardise: 1, sweep: 1, follow, top }));
      const map = this.#map(put, names);
      core.call("ssrvlad_map_query", map, queries, BigInt(count), steps, 1, decision, taken);
      core.call("ssrvlad_map_free", map);
      const weighed = core.get(Float64Array, weights, names.length);
      return {
        answers: this.#answers(core.get(Float32Array, scores, count * top), rows, right, top),
        steps: {
          frames: count,
          ...DECISION.values(core.get(Uint8Array, decision, DECISION.size)),
          ...TAKEN.values(core.get(Uint8Array, taken, TAKEN.size)),
          weights: names.map((name, at) => [CHANNELS[name].title, weighed[at]]),
        },
      };
    });
  }

  /** The address of the map by some channels. */
  #map(put, names) {
    const folders = this.frames.map((frame) => frame.slice(0, Math.max(0, frame.lastIndexOf("/"))));
    const starts = [...folders.keys()].filter((row) => !row || folders[row] !== folders[row - 1]);
    const size = { count: starts.length, rows: folders.length };
    const drives = DRIVES.bytes({ starts: put(BigInt64Array.from(starts, BigInt)), ...size });
    const map = this.core.call("ssrvlad_map_new_for", INTERFACE, put(drives));
    for (const name of names) {
      const { rows, columns, height, size } = this.channels[name];
      const [kind, { trust }] = [name === "features" ? SIGNS : VECTORS, CHANNELS[name]];
      const channel = put(CHANNEL.bytes({ rows, kind, columns, height, size, trust }));
      this.core.call("ssrvlad_map_add_channel", map, channel);
    }
    return map;
  }

  /** The address of the queries by some channels. */
  #queries(put, names, drive, columns) {
    const structs = names.flatMap((name) => {
      const { columns: across, height, size } = this.channels[name];
      const anchors = (name === "descriptor" && columns.length) || 1;
      const length = anchors * across * height * size;
      const odd = drive.find((frame) => frame[name]?.length !== length);
      if (odd)
        throw new Error(
          `expected a database of ${(odd[name]?.length ?? 0) / anchors} numbers a frame, got ${across * height * size}`,
        );
      const joined = new drive[0][name].constructor(drive.length * length);
      for (const [at, frame] of drive.entries()) joined.set(frame[name], at * length);
      return [...QUERIES.bytes({ descriptors: put(joined), anchors })];
    });
    return put(Uint8Array.from(structs));
  }

  #answers(scores, rows, right, top) {
    const at = this.core.get(BigInt64Array, rows, scores.length);
    const confidences = this.core.get(Float32Array, right, scores.length / top);
    return Array.from(confidences, (confidence, query) => {
      const places = Array.from({ length: top }, (_, place) => query * top + place);
      const known = places.filter((place) => at[place] >= 0);
      const candidates = known.map((place) => ({ frame: this.frames[at[place]], score: scores[place] }));
      return { confidence, candidates };
    });
  }
}

/** ``{shape, values}`` of the ``.npy`` file of a channel. */
function readArray(file, name) {
  const { type, axes } = CHANNELS[name];
  const view = new DataView(file.buffer, file.byteOffset, file.byteLength);
  if (decoder.decode(file.subarray(1, 6)) !== "NUMPY") throw new Error("expected a .npy file");
  const [begin, length] = file[6] > 1 ? [12, view.getUint32(8, true)] : [10, view.getUint16(8, true)];
  const header = decoder.decode(file.subarray(begin, begin + length));
  const shape = /'shape': \(([\d, ]+)\)/.exec(header)?.[1].split(", ").map(Number) ?? [];
  if (!header.includes(`'${type}'`) || !header.includes("False") || shape.length !== axes)
    throw new Error(`expected an array of ${axes} axes of ${type} in C order`);
  const content = file.slice(begin + length);
  const isBytes = type === "|u1";
  if (content.length !== productOf(shape) * (isBytes ? 1 : 4)) throw new Error("the .npy file is cut short");
  const values = isBytes ? content : new Float32Array(content.buffer);
  if (!values.every(Number.isFinite)) throw new Error(`${name}: expected an array of finite numbers`);
  return { shape, values };
}

function productOf(lengths) {
  return lengths.reduce((product, length) => product * length, 1);
}
