// Metadata and nodes of an ONNX file, read from its bytes: onnxruntime-web gives no metadata.
// Field numbers are those of onnx.proto.

const MODEL = { graph: 7, metadata: 14 };
const GRAPH = { node: 1, output: 12 };
const NODE = { output: 2 };
const LENGTH_DELIMITED = 2;

const decoder = new TextDecoder();
const encoder = new TextEncoder();

/** The properties ``ssrvlad.*``, by name without the prefix; empty for other files. */
export function metadataOf(file) {
  const properties = {};
  for (const entry of messages(file, MODEL.metadata)) {
    const [key, value] = [1, 2].map((field) => text(entry, field));
    if (key.startsWith("ssrvlad.")) properties[key.slice(8)] = value;
  }
  return properties;
}

/** Name of the tensor that holds the skeletons, or null. */
export function skeletonTensor(file) {
  for (const graph of messages(file, MODEL.graph)) {
    for (const node of messages(graph, GRAPH.node)) {
      for (const output of messages(node, NODE.output)) {
        const name = decoder.decode(output);
        if (/(^|\/)skeleton$/.test(name)) return name;
      }
    }
  }
  return null;
}

/** The file with one more output. Repeated messages are merged, so it is appended. */
export function withOutput(file, name) {
  const output = message(GRAPH.output, message(1, encoder.encode(name)));
  return join(file, message(MODEL.graph, output));
}

function text(bytes, field) {
  const [first] = messages(bytes, field);
  return first ? decoder.decode(first) : "";
}

/** The contents of every length-delimited field with this number. */
function* messages(bytes, number) {
  let at = 0;
  const varint = () => {
    let value = 0;
    for (let scale = 1; at < bytes.length; scale *= 128) {
      const byte = bytes[at++];
      value += (byte & 127) * scale;
      if (byte < 128) return value;
    }
    throw new Error("not an ONNX file, or one cut short");
  };
  while (at < bytes.length) {
    const tag = varint();
    const [field, kind] = [Math.floor(tag / 8), tag % 8];
    if (kind === 0) varint();
    else if (kind === 1) at += 8;
    else if (kind === 5) at += 4;
    else if (kind === LENGTH_DELIMITED) {
      const length = varint();
      if (at + length > bytes.length) throw new Error("not an ONNX file, or one cut short");
      if (field === number) yield bytes.subarray(at, at + length);
      at += length;
    } else throw new Error("not an ONNX file");
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
