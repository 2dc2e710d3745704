// The page: reads files, shows pictures and a table. `?model=&database=&labels=` opens files by URL,
// `?unchecked` does not run the golden pair.

import { Database } from "./database.js";
import { readLabels } from "./label_png.js";
import { Model } from "./model.js";
import { drawTarget, targetsOf } from "./targets.js";

const CATEGORIES = {
  ground: "#b58bb5",
  sidewalk: "#f5a3ee",
  building: "#a9a9a9",
  pole: "#e3c770",
  vegetation: "#a9c97b",
  sky: "#9cc4e4",
  "guard-rail": "#cdbccd",
  parking: "#fac8be",
};
const NO_LAYER = "#f4f4f4";
const TOP = 5;

const PHOTOS = [".png", ".jpg", ".jpeg", ".webp"];

const query = new URLSearchParams(location.search);
const open = { model: null, refusal: null, database: null, frame: null };
const element = (id) => document.getElementById(id);
const textOf = (bytes) => bytes && new TextDecoder().decode(bytes);

/** Opens files, ``{name: bytes}``, by the ends of their names, and describes the frame. */
async function openFiles(files) {
  const named = (ending) => Object.keys(files).find((name) => name.endsWith(ending));
  const model = named(".onnx");
  const array = Object.keys(files).find((name) => /(?<!\.features|\.hog)\.npy$/.test(name));
  const frame = PHOTOS.map(named).find((name) => name);
  if (model) {
    say("Loading the model …");
    Object.assign(open, { model: null, refusal: null });
    element("golden").value = "";
    open.model = await Model.load(files[model], !query.has("unchecked")).catch((error) => {
      throw (open.refusal = error);
    });
    element("golden").value = open.model.checked?.text ?? "The golden pair was not run.";
  }
  if (array) {
    const frames = textOf(files[`${array}.frames.txt`]);
    if (frames === undefined) throw new Error(`choose ${array}.frames.txt together with ${array}`);
    const named = { descriptor: array, features: `${array}.features.npy`, hog: `${array}.hog.npy` };
    const channels = Object.entries(named)
      .filter(([, file]) => files[file])
      .map(([name, file]) => [
        name,
        { bytes: files[file], fingerprint: textOf(files[`${file}.fingerprint.txt`]) },
      ]);
    open.database = new Database(frames, Object.fromEntries(channels));
  }
  if (frame) open.frame = { name: frame, bytes: files[frame] };
  if (!model && !array && !frame) throw new Error("expected .onnx, .npy with .txt, or picture files");
  await describe();
}

/** ``{pixels, height, width}`` of a photograph, RGB bytes, turned upright by its EXIF. */
async function readPhoto(bytes) {
  const bitmap = await createImageBitmap(new Blob([bytes]));
  const { width, height } = bitmap;
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(bitmap, 0, 0);
  const { data } = context.getImageData(0, 0, width, height);
  if (data.some((value, at) => at % 4 === 3 && value < 255))
    throw new Error("the picture has transparent pixels; expected a photograph without");
  return { pixels: data.filter((_, at) => at % 4 < 3), height, width };
}

async function describe() {
  const { model, database, frame } = open;
  element("result").hidden = true;
  if (open.refusal) throw open.refusal;
  if (!model) return say("Choose a model.");
  const channels = database?.channels ?? {};
  for (const [name, { fingerprint }] of Object.entries(channels))
    if (fingerprint && model.channels[name] && fingerprint !== model.channels[name])
      throw new Error(`the database has ${name} "${fingerprint}", the model "${model.channels[name]}"`);
  if (!frame && model.takesPhotos) return say("Choose a photograph.");
  if (!frame) return say(`Labels of ${model.space.name}: choose a label map.`);
  const picture = model.takesPhotos
    ? await readPhoto(frame.bytes)
    : await readLabels(frame.bytes, model.space.classes);
  const start = performance.now();
  const described = model.takesPhotos ? await model.describePhoto(picture) : await model.describe(picture);
  const milliseconds = Math.round(performance.now() - start);
  element("result").hidden = false;
  drawMap(model, { ...picture, labels: described.labels ?? picture.labels }, described);
  drawTargets(model, described);
  listMatches(database?.search(described, TOP) ?? []);
  const unchecked = database && !channels.descriptor.fingerprint ? " The database has no fingerprint." : "";
  const shared = Object.keys(channels).filter((name) => model.channels[name]);
  const apart = Object.keys(model.channels)
    .filter((name) => database && !channels[name] !== !model.channels[name])
    .map((name) => ` Only the ${channels[name] ? "database" : "model"} has ${name}: matched without.`);
  const scores = shared.length > 1 ? ` Scores are of ${shared.join(", ")} together.` : "";
  const size = `${picture.height} x ${picture.width}`;
  say(`${frame.name}: ${size}, ${milliseconds} ms.${scores}${unchecked}${apart.join("")}`);
}

function drawMap({ space }, { labels, height, width }, { skeleton, rows, columns }) {
  const colours = Object.fromEntries(space.classes.map(({ id, category }) => [id, CATEGORIES[category]]));
  const canvas = element("map");
  [canvas.height, canvas.width] = [height, width];
  const context = canvas.getContext("2d");
  const picture = context.createImageData(width, height);
  const pixels = new Uint32Array(picture.data.buffer);
  const packed = (colour) => {
    const [red, green, blue] = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
    return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  };
  labels.forEach((id, at) => (pixels[at] = packed(colours[id] ?? NO_LAYER)));
  context.putImageData(picture, 0, 0);
  context.fillStyle = "#000";
  const [tall, wide] = [height / rows, width / columns];
  skeleton?.forEach((layers, at) => {
    const [y, x] = [Math.floor(at / columns), at % columns];
    if (layers) context.fillRect(x * wide + wide / 4, y * tall + tall / 4, wide / 2, tall / 2);
  });
}

function drawTargets({ config }, { descriptor }) {
  element("legend").textContent =
    config.aggregation === "residuals"
      ? "Rings by distance, sectors by direction: red where there is more skeleton around the keypoints " +
        "of a category than around its centre, blue where there is less."
      : "Rings by distance from the vanishing column, sectors by direction: how much of a category, of " +
        "two that count as one, or of the boundaries between categories lies there, reconstructed from " +
        "its numbers. Red is much, white nothing; pale blue is an error of the smooth basis.";
  const targets = targetsOf(config, descriptor, Object.keys(CATEGORIES)).map((found) => {
    const name = found.names.join(", ");
    const target = document.createElement("div");
    target.className = "target";
    target.innerHTML =
      '<canvas width="320" height="320" role="img"></canvas>' +
      "<p><b></b></p>";
    target.querySelector("canvas").setAttribute("aria-label", `target of ${name}`);
    target.querySelector("b").textContent = name;
    for (const category of found.names.filter((each) => each in CATEGORIES).reverse()) {
      const square = document.createElement("i");
      square.style.background = CATEGORIES[category];
      target.querySelector("p").prepend(square, " ");
    }
    drawTarget(target.querySelector("canvas"), found);
    return target;
  });
  element("targets").replaceChildren(...targets);
}

function listMatches(candidates) {
  const body = element("matches").tBodies[0];
  body.replaceChildren();
  if (!candidates.length) {
    const message = open.database ? "no candidates" : "choose a database";
    candidates = [{ frame: message, score: null }];
  }
  for (const { frame, score } of candidates) {
    const row = body.insertRow();
    row.insertCell().textContent = frame;
    row.insertCell().textContent = score === null ? "" : score.toFixed(4);
  }
}

function say(text, error = false) {
  element("status").textContent = text;
  element("status").classList.toggle("error", error);
}

/** Runs a job after the ones before it; shows its error in the status line. */
let last = Promise.resolve();
function attempt(job) {
  last = last.then(job).catch((error) => {
    element("result").hidden = true;
    say(error.message, true);
  });
  return last;
}

async function bytesOf(list) {
  const entries = Array.from(list, async (file) => [file.name, new Uint8Array(await file.arrayBuffer())]);
  return Object.fromEntries(await Promise.all(entries));
}

/** The file of a URL and, for an array, the files beside it, as the server has them now. */
async function fetched(address) {
  const files = {};
  const arrays = [".features.npy", ".hog.npy"];
  const texts = ["", ...arrays].map((ending) => `${ending}.fingerprint.txt`);
  const beside = [".frames.txt", ...arrays, ...texts];
  const others = address.endsWith(".npy") ? beside : [];
  for (const ending of ["", ...others]) {
    const response = await fetch(address + ending, { cache: "no-cache" });
    if (response.ok) files[(address + ending).split("/").pop()] = new Uint8Array(await response.arrayBuffer());
    else if (!ending) throw new Error(`${address}: ${response.status} ${response.statusText}`);
  }
  return files;
}

for (const name of ["model", "database", "labels"]) {
  const input = element(`${name}-file`);
  input.addEventListener("change", () => attempt(async () => openFiles(await bytesOf(input.files))));
  const address = query.get(name);
  if (address) attempt(async () => openFiles(await fetched(address)));
}
for (const kind of ["dragover", "dragleave", "drop"])
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", kind === "dragover");
  });
document.addEventListener("drop", ({ dataTransfer }) => {
  const files = Array.from(dataTransfer.files);
  attempt(async () => openFiles(await bytesOf(files)));
});
