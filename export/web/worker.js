// The worker of the page: the model, and the map in the memory of the core. While it computes, the page can
// be read and scrolled. `Remote` in remote.js calls its jobs.

import { Core, CoreStopped } from "./core.js";
import { Database } from "./database.js";
import { Model } from "./model.js";

let [core, model, database] = [null, null, null];

const JOBS = {
  /** Loads a model, see `Model.load`, and returns what the page must know of it. */
  async openModel(file, check) {
    model = null;
    model = await Model.load(file, check);
    const { channels, checked, columns, config, space, takesPhotos } = model;
    return { channels, checked, columns, config, space, takesPhotos };
  },

  /** Opens a map, see `Database`; returns the number of its frames, and its channels. */
  async openDatabase(frames, channels) {
    core ??= await Core.load();
    database?.free();
    database = null;
    database = new Database(core, frames, channels);
    return { count: database.frames.length, channels: database.channels };
  },

  /** What the model says of a photograph or a label map. */
  describe: (picture) => (model.takesPhotos ? model.describePhoto(picture) : model.describe(picture)),

  /** Finds the frames of a drive, see `Database.query`. */
  query(drive, top) {
    if (!database) throw new Error("the database is closed, for the core stopped: open it again");
    return database.query(drive, model.columns, top);
  },
};

addEventListener("message", async ({ data: { number, job, given } }) => {
  try {
    postMessage({ number, answer: await JOBS[job](...given) });
  } catch (error) {
    if (error instanceof CoreStopped) core = database = null;
    postMessage({ number, refusal: error.message ?? `${error}` }); // onnxruntime-web also throws numbers
  }
});
