// Calls the jobs of worker.js.

export class Remote {
  #waiting = new Map();
  #worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });
  #calls = 0;
  #broken = null;

  constructor() {
    this.#worker.addEventListener("message", ({ data: { number, answer, refusal } }) => {
      const { done, fail } = this.#waiting.get(number);
      this.#waiting.delete(number);
      if (refusal === undefined) done(answer);
      else fail(new Error(refusal));
    });
    this.#worker.addEventListener("error", ({ message }) => {
      this.#broken = new Error(`worker.js cannot run: ${message ?? "is it beside the page?"}`);
      for (const { fail } of this.#waiting.values()) fail(this.#broken);
      this.#waiting.clear();
    });
  }

  /** What a job answers; its error is this one's. */
  call(job, ...given) {
    if (this.#broken) return Promise.reject(this.#broken);
    const number = this.#calls++;
    return new Promise((done, fail) => {
      this.#waiting.set(number, { done, fail });
      this.#worker.postMessage({ number, job, given });
    });
  }
}
