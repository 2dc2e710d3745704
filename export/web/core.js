// The native core of the package, C++ as WebAssembly: `npm run build` makes ssrvlad.wasm. Its functions
// are those of ssrvlad_torch/native/*.h, with addresses as numbers and 64-bit integers as BigInt.

const NO_SYSTEM = 52; // what the functions of the system answer that only report a crash

export class Core {
  static async load() {
    const answer = await fetch(new URL("ssrvlad.wasm", import.meta.url), { cache: "no-cache" });
    if (!answer.ok) throw new Error('no ssrvlad.wasm beside the page: "npm run build" makes it');
    const system = Object.fromEntries(["close", "seek", "write"].map((name) => [`fd_${name}`, () => NO_SYSTEM]));
    const bytes = await answer.arrayBuffer();
    const { instance } = await WebAssembly.instantiate(bytes, { wasi_snapshot_preview1: system });
    instance.exports._initialize();
    return new Core(instance.exports);
  }

  constructor(functions) {
    this.functions = functions;
  }

  /** What a function of the core answers. Without memory the core stops for good. */
  call(name, ...parameters) {
    try {
      return this.functions[name](...parameters);
    } catch (error) {
      if (!(error instanceof WebAssembly.RuntimeError)) throw error;
      throw new Error(`the core stopped in ${name}, probably for want of memory: load the page again`);
    }
  }

  /**
   * What a job returns that is given three functions: `room` takes bytes of the core's memory until
   * the job ends, `put` copies an array there; both return an address. `get` copies an array of a type
   * and length from an address.
   */
  using(job) {
    const taken = [];
    const room = (bytes) => {
      const address = this.call("malloc", bytes);
      if (!address) throw new Error(`the core has no memory for ${bytes} bytes`);
      taken.push(address);
      return address;
    };
    const bytesAt = (address, length) => new Uint8Array(this.functions.memory.buffer, address, length);
    const put = (array) => {
      const address = room(array.byteLength);
      const { buffer, byteOffset, byteLength } = array;
      bytesAt(address, byteLength).set(new Uint8Array(buffer, byteOffset, byteLength));
      return address;
    };
    const get = (Type, address, length) =>
      new Type(bytesAt(address, length * Type.BYTES_PER_ELEMENT).slice().buffer);
    try {
      return job({ room, put, get });
    } finally {
      for (const address of taken) this.functions.free(address);
    }
  }
}
