// What an ONNX file says about itself, read from its bytes: onnxruntime-web gives no metadata.
// The fields are those of onnx.proto; only the outermost message, nodes and properties are read.

const MODEL = { graph: 7, metadata: 14 };
const GRAPH = { node: 1, output: 12 };
const NODE = { output: 2, name: 3, operator: 4 };
const LENGTH_DELIMITED = 2;

const decoder = new TextDecoder();
const encoder = new TextEncoder();

/** The properties ``ssrvlad.*`` by name without the prefix; empty for a file of another kind. */
export function metadataOf(file) {
  const found = {};
  for (const entry of messages(file, MODEL.metadata)) {
    const [key, value] = [1, 2].map((field) => text(entry, field));
    if (key.startsWith("ssrvlad.")) found[key.slice(8)] = value;
  }
  return found;
}

/** Name of the tensor that holds the skeleton with its margins, or null. */
export function skeletonTensor(file) {
  for (const graph of messages(file, MODEL.graph)) {
    for (const node of messages(graph, GRAPH.node)) {
      const isThinning = /(^|\/)skeleton\/Loop/.test(text(node, NODE.name));
      if (isThinning && text(node, NODE.operator) === "Loop") return text(node, NODE.output);
    }
  }
  return null;
}

/** The file with one more output. Messages that stand twice are merged, so it is only appended. */
export function withOutput(file, name) {
  const output = message(GRAPH.output, message(1, encoder.encode(name)));
  return join(file, message(MODEL.graph, output));
}

function text(bytes, field) {
  const [first] = messages(bytes, field);
  return first ? decoder.decode(first) : "";
}

/** The contents of every field of this number that has a length. */
function* messages(bytes, wanted) {
  let at = 0;
  const varint = () => {
    let value = 0;
    for (let scale = 1; at < bytes.length; scale *= 128) {
      const byte = bytes[at++];
      value += (byte & 127) * scale;
      if (byte < 128) return value;
    }
    throw new Error("no ONNX file, or one cut short");
  };
  while (at < bytes.length) {
    const tag = varint();
    const [field, kind] = [Math.floor(tag / 8), tag % 8];
    if (kind === 0) varint();
    else if (kind === 1) at += 8;
    else if (kind === 5) at += 4;
    else if (kind === LENGTH_DELIMITED) {
      const length = varint();
      if (at + length > bytes.length) throw new Error("no ONNX file, or one cut short");
      if (field === wanted) yield bytes.subarray(at, at + length);
      at += length;
    } else throw new Error("no ONNX file");
  }
}

function message(field, content) {
  const length = [];
  let rest = content.length;
  for (; rest > 127; rest = Math.floor(rest / 128)) length.push((rest % 128) + 128);
  return join(Uint8Array.of(field * 8 + LENGTH_DELIMITED, ...length, rest), content);
}

function join(first, second) {
  const both = new Uint8Array(first.length + second.length);
  both.set(first);
  both.set(second, first.length);
  return both;
}
