// The page: reads files, shows pictures and a table. `?model=&database=&labels=` opens files by URL,
// `?unchecked` does not run the golden pair.

import { inOrder, looksLikeLabels } from "./frames.js";
import { HEAD, isGrayPng, readLabels } from "./label_png.js";
import { Remote } from "./remote.js";
import { drawTarget, targetsOf } from "./targets.js";
import { scoreInWords, stepsInWords } from "./words.js";

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

const PICTURE = /(^|\/)[^./][^/]*\.(png|jpe?g|webp)$/i;

const query = new URLSearchParams(location.search);
const open = { model: null, refusal: null, database: null, frames: [], described: null };
const element = (id) => document.getElementById(id);
const bytesOf = async (file) => new Uint8Array(await file.arrayBuffer());
const lastOf = (path) => path.split("/").pop();
const remote = new Remote();

/** Opens files, by their names, as the ends of the names say, and finds the frames. */
async function openFiles(files) {
  const names = Object.keys(files);
  const model = names.find((name) => name.endsWith(".onnx"));
  const array = names.find((name) => /(?<!\.features|\.hog|\.poses)\.npy$/.test(name));
  const frames = names.filter((name) => PICTURE.test(name)).sort(inOrder);
  if (!model && !array && !frames.length)
    throw new Error("expected .onnx, .npy with .txt, or picture files");
  const folders = [...new Set(frames.map((name) => name.slice(0, -lastOf(name).length)))];
  if (folders.length > 1)
    throw new Error(`expected the frames of one drive, got those of ${folders.join(", ")}`);
  if (model) await openModel(files[model]);
  if (array) await openDatabase(files, array);
  if (frames.length)
    Object.assign(open, { frames: frames.map((name) => ({ name, file: files[name] })), described: null });
  await find();
}

async function openModel(file) {
  say("Loading the model …");
  Object.assign(open, { model: null, refusal: null, described: null });
  element("golden").value = "";
  const load = remote.call("openModel", await bytesOf(file), !query.has("unchecked"));
  open.model = await load.catch((error) => {
    throw (open.refusal = error);
  });
  element("golden").value = open.model.checked?.text ?? "The golden pair was not run.";
}

async function openDatabase(files, array) {
  const text = async (name) => files[name] && (await files[name].text());
  const frames = await text(`${array}.frames.txt`);
  if (frames === undefined) throw new Error(`choose ${array}.frames.txt together with ${array}`);
  const channels = {};
  for (const [name, ending] of [["descriptor", ""], ["features", ".features.npy"], ["hog", ".hog.npy"]]) {
    const file = array + ending;
    const fingerprint = await text(`${file}.fingerprint.txt`);
    if (files[file]) channels[name] = { bytes: await bytesOf(files[file]), fingerprint };
  }
  open.database = null;
  open.database = await remote.call("openDatabase", frames, channels);
}

/** ``{pixels, height, width}`` of a photograph, RGB bytes, turned upright by its EXIF. What looks like a
 * label map is an error, as in `ssrvlad encode`. */
async function readPhoto(file) {
  const bitmap = await createImageBitmap(file, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const { width, height } = bitmap;
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(bitmap, 0, 0);
  const { data } = context.getImageData(0, 0, width, height);
  if (data.some((value, at) => at % 4 === 3 && value < 255))
    throw new Error("the picture has transparent pixels; expected a photograph without");
  const isGray = isGrayPng(await bytesOf(file.slice(0, HEAD)));
  if (isGray && looksLikeLabels(data.filter((_, at) => at % 4 === 0), width))
    throw new Error("expected a photograph, got a label map");
  return { pixels: data.filter((_, at) => at % 4 < 3), height, width };
}

/** Describes all frames, if they are new, and finds them in the database; shows the first. */
async function find() {
  const { model, database, frames } = open;
  element("result").hidden = true;
  if (open.refusal) throw open.refusal;
  if (!model) return say("Choose a model.");
  for (const [name, { fingerprint }] of Object.entries(database?.channels ?? {}))
    if (fingerprint && model.channels[name] && fingerprint !== model.channels[name])
      throw new Error(`the database has ${name} "${fingerprint}", the model "${model.channels[name]}"`);
  if (!frames.length && model.takesPhotos) return say("Choose photographs.");
  if (!frames.length) return say(`Labels of ${model.space.name}: choose label maps.`);
  open.described ??= await describeAll(frames);
  const { drive, told } = open.described;
  let found = null;
  if (database) {
    say(`Finding ${drive.length} frames among ${database.count} …`);
    found = await remote.call("query", drive.map(({ channels }) => channels), TOP);
  }
  const steps = found && stepsInWords(found.steps, model.columns, database.count);
  element("steps").textContent = steps ?? "";
  listDrive(drive, found);
  await show(drive, found, 0);
  element("result").hidden = false;
  say(`${[...told, ...notesOf(model, database)].join("; ")}.`);
}

/** The frames that can be described, with the arrays of their channels, and of the first one all that was
 * seen; and in words what was done. */
async function describeAll(frames) {
  const [drive, skipped, start] = [[], [], performance.now()];
  const [several, progress] = [frames.length > 1, element("progress")];
  progress.hidden = !several;
  for (const [at, frame] of frames.entries()) {
    if (several) say(`Describing frame ${at + 1} of ${frames.length} …`);
    progress.value = at / frames.length;
    try {
      const seen = await see(frame);
      const { descriptor, features, hog } = seen.described;
      drive.push({ frame, channels: { descriptor, features, hog }, seen: drive.length ? null : seen });
    } catch (error) {
      skipped.push(`${frame.name}: ${error.message}`);
    }
  }
  progress.hidden = true;
  if (!drive.length) throw new Error(several ? `no frame can be described: ${skipped[0]}` : skipped[0]);
  const milliseconds = Math.round((performance.now() - start) / frames.length);
  const what = several ? `${drive.length} frames` : frames[0].name;
  const told = [`${what}, ${milliseconds} ms${several ? " each" : ""}`];
  if (skipped.length) told.push(`skipped ${skipped.length} of ${frames.length} frames: ${skipped[0]}`);
  return { drive, told };
}

/** What a database and a model do not both have. */
function notesOf(model, database) {
  if (!database) return [];
  const notes = database.channels.descriptor.fingerprint ? [] : ["the database has no fingerprint"];
  for (const name of Object.keys(model.channels)) {
    const [here, there] = [model.channels[name], database.channels[name]];
    if (here && !there) notes.push(`only the model has ${name}: matched without`);
    if (there && !here) notes.push(`only the database has ${name}: matched without; fuse the file again`);
  }
  return notes;
}

/** A picture, and what the model says of it. */
async function see({ file }) {
  const { model } = open;
  const picture = model.takesPhotos
    ? await readPhoto(file)
    : await readLabels(await bytesOf(file), model.space.classes);
  const described = await remote.call("describe", picture);
  return { picture: { ...picture, labels: described.labels ?? picture.labels }, described };
}

/** Shows one frame of a drive, and the places of all. */
async function show(drive, found, shown) {
  const { model } = open;
  element("frame").textContent = lastOf(drive[shown].frame.name);
  const { picture, described } = drive[shown].seen ?? (await see(drive[shown].frame));
  drawMap(model, picture);
  drawTargets(model, described.usual);
  listMatches(found, shown);
  for (const [at, row] of [...element("places").tBodies[0].rows].entries())
    row.classList.toggle("shown", at === shown);
}

function drawMap({ space }, { labels, height, width }) {
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
}

function drawTargets({ config }, descriptor) {
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

/** The candidates of the shown frame. */
function listMatches(found, shown) {
  const body = element("matches").tBodies[0];
  body.replaceChildren();
  for (const heading of document.querySelectorAll(".score"))
    heading.textContent = found ? scoreInWords(found.steps) : "Score";
  const { candidates = [], confidence } = found?.answers[shown] ?? {};
  element("confidence").textContent = candidates.length
    ? `Confidence that the first is right: ${confidence.toFixed(2)}`
    : "";
  const none = { frame: found ? "no candidates" : "choose a database", score: null };
  for (const { frame, score } of candidates.length ? candidates : [none])
    addRow(body, frame, score === null ? "" : score.toFixed(4));
}

/** The place of each frame; a frame that is chosen is shown. */
function listDrive(drive, found) {
  element("drive").hidden = drive.length < 2 || !found;
  const body = element("places").tBodies[0];
  body.replaceChildren();
  for (const [at, { frame }] of drive.entries()) {
    const { candidates = [], confidence = 0 } = found?.answers[at] ?? {};
    const [place] = candidates;
    const score = place?.score.toFixed(4) ?? "";
    const row = addRow(body, "", place?.frame ?? "no place", score, confidence.toFixed(2));
    const button = document.createElement("button");
    button.textContent = lastOf(frame.name);
    button.addEventListener("click", () => attempt(() => show(drive, found, at)));
    row.cells[0].append(button);
    row.lastElementChild.style.setProperty("--part", confidence);
  }
}

function addRow(body, ...texts) {
  const row = body.insertRow();
  for (const text of texts) row.insertCell().textContent = text;
  return row;
}

function say(text, error = false) {
  element("status").textContent = text;
  element("status").classList.toggle("error", error);
}

/** Runs a job after the ones before it; shows its error in the status line. */
let last = Promise.resolve();
function attempt(job) {
  last = last.then(job).catch((error) => {
    element("result").hidden = element("progress").hidden = true;
    say(error.message, true);
  });
  return last;
}

const named = (files) => Object.fromEntries(Array.from(files, (file) => [file.name, file]));

/** The file of a URL and, for an array, the files beside it, as the server has them now. */
async function fetched(address) {
  const files = {};
  const arrays = [".features.npy", ".hog.npy"];
  const texts = ["", ...arrays].map((ending) => `${ending}.fingerprint.txt`);
  const beside = [".frames.txt", ...arrays, ...texts];
  const others = address.endsWith(".npy") ? beside : [];
  for (const ending of ["", ...others]) {
    const response = await fetch(address + ending, { cache: "no-cache" });
    if (response.ok) files[lastOf(address + ending)] = await response.blob();
    else if (!ending) throw new Error(`${address}: ${response.status} ${response.statusText}`);
  }
  return files;
}

/** The files of what was dropped, and those in its folders, by their paths. */
async function filesOf(entries) {
  const files = {};
  for (const entry of entries) {
    if (entry.isFile) {
      files[entry.fullPath.slice(1)] = await new Promise((done, fail) => entry.file(done, fail));
      continue;
    }
    const reader = entry.createReader();
    const next = () => new Promise((done, fail) => reader.readEntries(done, fail));
    for (let some = await next(); some.length; some = await next()) Object.assign(files, await filesOf(some));
  }
  return files;
}

const INPUTS = ["model", "database", "labels"];
for (const input of INPUTS.map((name) => element(`${name}-file`)))
  input.addEventListener("change", () => attempt(() => openFiles(named(input.files))));
const addresses = INPUTS.map((name) => query.get(name)).filter(Boolean);
if (addresses.length)
  attempt(async () => openFiles(Object.assign({}, ...(await Promise.all(addresses.map(fetched))))));
for (const kind of ["dragover", "dragleave", "drop"])
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", kind === "dragover");
  });
document.addEventListener("drop", ({ dataTransfer }) => {
  const entries = Array.from(dataTransfer.items, (item) => item.webkitGetAsEntry()).filter(Boolean);
  attempt(async () => openFiles(await filesOf(entries)));
});
