// The native core of the package, C++ as WebAssembly: `npm run build` makes ssrvlad.wasm. Its functions
// are those of ssrvlad_torch/native/*.h. Addresses are numbers, 64-bit integers BigInt. There are no
// exceptions: where a function would return an error, the core stops.

export const INTERFACE = 5; // SSRVLAD_INTERFACE of the headers from which structs and calls are taken
const NO_SYSTEM = 52; // what the functions answer that would only report a crash

export const [INT, ADDRESS, LONG, DOUBLE] = ["Int32", "Int32", "BigInt64", "Float64"];
const SIZES = { [INT]: 4, [LONG]: 8, [DOUBLE]: 8 };

/** The form of a C struct that has a field of 8 bytes, of the type of each field by its name. */
export class Struct {
  constructor(types) {
    this.fields = {};
    let end = 0;
    for (const [name, type] of Object.entries(types)) {
      const at = Math.ceil(end / SIZES[type]) * SIZES[type];
      this.fields[name] = { type, at };
      end = at + SIZES[type];
    }
    this.size = Math.ceil(end / 8) * 8;
  }

  /** The bytes of one with some values, and 0 for the others. */
  bytes(values) {
    const view = new DataView(new ArrayBuffer(this.size));
    for (const [name, value] of Object.entries(values)) {
      const { type, at } = this.fields[name];
      view[`set${type}`](at, type === LONG ? BigInt(value) : value, true);
    }
    return new Uint8Array(view.buffer);
  }

  /** The values of one in its bytes, as numbers. */
  values({ buffer }) {
    const view = new DataView(buffer);
    const valued = ([name, { type, at }]) => [name, Number(view[`get${type}`](at, true))];
    return Object.fromEntries(Object.entries(this.fields).map(valued));
  }
}

/** The core cannot be used any more; a new one can. */
export class CoreStopped extends Error {}

export class Core {
  static async load() {
    const answer = await fetch(new URL("ssrvlad.wasm", import.meta.url), { cache: "no-cache" });
    if (!answer.ok) throw new Error('no ssrvlad.wasm beside the page: "npm run build" makes it');
    const nothing = () => NO_SYSTEM;
    const system = { fd_close: nothing, fd_seek: nothing, fd_write: nothing };
    const bytes = await answer.arrayBuffer();
    const { instance } = await WebAssembly.instantiate(bytes, { wasi_snapshot_preview1: system });
    instance.exports._initialize();
    const found = instance.exports.ssrvlad_interface?.() ?? "none";
    if (found !== INTERFACE)
      throw new Error(
        `ssrvlad.wasm: expected interface ${INTERFACE}, got ${found}; "npm run build" makes it again`,
      );
    return new Core(instance.exports);
  }

  constructor(functions) {
    this.functions = functions;
  }

  /** What a function of the core returns. */
  call(name, ...parameters) {
    try {
      return this.functions[name](...parameters);
    } catch (error) {
      if (!(error instanceof WebAssembly.RuntimeError)) throw error;
      throw new CoreStopped(`the core stopped in ${name}, for want of memory or by what it was given`);
    }
  }

  /** The address of some bytes of the core's memory, until `free`. */
  room(bytes) {
    const address = this.call("malloc", bytes) >>> 0;
    if (!address && bytes) throw new Error(`the core has no memory for ${bytes} bytes`);
    return address;
  }

  /** The address of a copy of an array. */
  put({ buffer, byteOffset, byteLength }) {
    const address = this.room(byteLength);
    new Uint8Array(this.functions.memory.buffer).set(new Uint8Array(buffer, byteOffset, byteLength), address);
    return address;
  }

  /** A copy of an array of a type and length at an address. */
  get(Type, address, length) {
    const end = address + length * Type.BYTES_PER_ELEMENT;
    return new Type(this.functions.memory.buffer.slice(address, end));
  }

  free(address) {
    this.call("free", address);
  }

  /** What a job returns that is given `room` and `put`, whose memory is free after it. */
  using(job) {
    const taken = [];
    const until = (take) => (given) => {
      taken.push(take.call(this, given));
      return taken.at(-1);
    };
    try {
      return job({ room: until(this.room), put: until(this.put) });
    } finally {
      for (const address of taken) this.free(address);
    }
  }
}
