// Metadata of an ONNX file, read from its bytes: onnxruntime-web gives none. Field numbers are those of
// onnx.proto.

const METADATA = 14;
const LENGTH_DELIMITED = 2;
const decoder = new TextDecoder();

/** The properties ``ssrvlad.*``, by name without the prefix; empty for other files. */
export function metadataOf(file) {
  const properties = {};
  for (const entry of messages(file, METADATA)) {
    const [key, value] = [1, 2].map((field) => decoder.decode([...messages(entry, field)][0]));
    if (key.startsWith("ssrvlad.")) properties[key.slice(8)] = value;
  }
  return properties;
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
