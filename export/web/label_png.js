// Label ids of a PNG. A canvas would give colours instead of a palette's indices, and gray values that
// colour profiles or protection against browser fingerprinting change.

const SIGNATURE = [137, 80, 78, 71, 13, 10, 26, 10];
const [GRAY, PALETTE] = [0, 3];
const PAETH = 4;
const COLOUR_AT = 25;
/** Bytes of a file that `isGrayPng` needs: up to the colour type in the header, its first chunk. */
export const HEAD = COLOUR_AT + 1;
const BITS = { [GRAY]: [8, 16], [PALETTE]: [1, 2, 4, 8] };
const CRC = Uint32Array.from({ length: 256 }, (_, byte) => {
  let crc = byte;
  for (let bit = 0; bit < 8; bit++) crc = crc & 1 ? 0xedb88320 ^ (crc >>> 1) : crc >>> 1;
  return crc;
});

/**
 * ``{labels, height, width}`` of a PNG; labels are an array of unsigned integers. `classes` are those of
 * the label space: see `idsOfPalette`.
 */
export async function readLabels(file, classes) {
  const view = new DataView(file.buffer, file.byteOffset, file.byteLength);
  if (SIGNATURE.some((byte, at) => file[at] !== byte)) throw new Error("expected a PNG");
  const parts = [];
  let [header, colours] = [null, null];
  for (let at = 8; at + 12 <= file.length; ) {
    const length = view.getUint32(at);
    const kind = String.fromCharCode(...file.subarray(at + 4, at + 8));
    if (at + 12 + length > file.length) throw new Error("the PNG is cut short");
    if (crc32(file.subarray(at + 4, at + 8 + length)) !== view.getUint32(at + 8 + length))
      throw new Error(`the PNG is damaged: wrong checksum of ${kind}`);
    if (kind === "IHDR") header = headerOf(view, at + 8);
    if (kind === "PLTE") colours = file.subarray(at + 8, at + 8 + length);
    if (kind === "IDAT") parts.push(file.subarray(at + 8, at + 8 + length));
    at += 12 + length;
  }
  if (!header) throw new Error("the PNG has no header");
  const rows = unfiltered(await inflated(parts), header);
  const values = unpacked(rows, header);
  const labels = header.colour === PALETTE ? idsOfPalette(values, colours, classes) : values;
  return { ...header, labels };
}

/** Whether a file is a PNG of gray values. */
export function isGrayPng(file) {
  return SIGNATURE.every((byte, at) => file[at] === byte) && file[COLOUR_AT] === GRAY;
}

function crc32(bytes) {
  let crc = ~0;
  for (const byte of bytes) crc = CRC[(crc ^ byte) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

/** The rule of `ssrvlad encode`: ids are the indices, unless the palette shows other ids. */
function idsOfPalette(indices, colours, classes) {
  if (!colours) throw new Error("the PNG has no palette");
  const known = classes.filter(({ colour }) => colour).sort((a, b) => a.id - b.id);
  const ids = new Map(known.map(({ id, colour }) => [colour.join(), id]));
  const own = new Map(known.map(({ id, colour }) => [id, colour.join()]));
  const used = [...new Set(indices)].sort((a, b) => a - b);
  const shown = (i) => colours.subarray(3 * i, 3 * i + 3).join();
  const others = used.filter((i) => shown(i) !== (own.get(i) ?? "0,0,0"));
  let moved = others.filter((i) => ids.has(shown(i)));
  const strays = others.filter((i) => !moved.includes(i));
  let unclear = moved.length ? strays : [];
  if (used.every((i) => new Set(shown(i).split(",")).size === 1)) {
    const areIds = strays.length && used.every((i) => shown(i) === [i, i, i].join());
    [moved, unclear] = [[], areIds ? [] : others];
  }
  if (unclear.length)
    throw new Error(
      `the palette shows index ${unclear[0]} as (${shown(unclear[0])}); expected colours of the label ` +
        "space alone, or an image without palette, to tell which is the id",
    );
  const table = new Map(moved.map((i) => [i, ids.get(shown(i))]));
  return Uint16Array.from(indices, (i) => table.get(i) ?? i);
}

/** Decompresses zlib data; with `size`, the content must have that many bytes. */
export async function inflated(parts, size = null) {
  const stream = new Blob(parts).stream().pipeThrough(new DecompressionStream("deflate"));
  if (size === null) return new Uint8Array(await new Response(stream).arrayBuffer());
  const content = new Uint8Array(size);
  let filled = 0;
  const reader = stream.getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    if (filled + part.value.length > size) throw new Error("expected less compressed content");
    content.set(part.value, filled);
    filled += part.value.length;
  }
  if (filled < size) throw new Error("expected more compressed content");
  return content;
}

function headerOf(view, at) {
  const [width, height] = [view.getUint32(at), view.getUint32(at + 4)];
  const [bits, colour, , , interlaced] = Array.from({ length: 5 }, (_, i) => view.getUint8(at + 8 + i));
  if (!BITS[colour]?.includes(bits)) throw new Error("expected a PNG of gray of 8 or 16 bits, or of a palette");
  if (interlaced) throw new Error("expected a PNG that is not interlaced");
  if (!width || !height) throw new Error("expected at least one pixel");
  return { width, height, bits, colour };
}

/** The bytes of all rows. Each byte was stored as its difference from a prediction. */
function unfiltered(content, { width, height, bits }) {
  const length = Math.ceil((width * bits) / 8);
  const step = Math.max(1, bits / 8);
  if (content.length < height * (length + 1)) throw new Error("the PNG is cut short");
  const rows = new Uint8Array(height * length);
  for (let y = 0; y < height; y++) {
    const filter = content[y * (length + 1)];
    if (filter > PAETH) throw new Error(`the PNG is damaged: filter ${filter}`);
    for (let x = 0; x < length; x++) {
      const at = y * length + x;
      const left = x >= step ? rows[at - step] : 0;
      const up = y ? rows[at - length] : 0;
      const corner = y && x >= step ? rows[at - length - step] : 0;
      rows[at] = content[y * (length + 1) + 1 + x] + prediction(filter, left, up, corner);
    }
  }
  return rows;
}

function prediction(filter, left, up, corner) {
  if (filter < PAETH) return [0, left, up, (left + up) >> 1][filter];
  const [a, b, c] = [up - corner, left - corner, left + up - 2 * corner].map(Math.abs);
  return a <= b && a <= c ? left : b <= c ? up : corner;
}

function unpacked(rows, { width, height, bits }) {
  if (bits === 8) return rows;
  if (bits === 16) {
    const view = new DataView(rows.buffer);
    return Uint16Array.from({ length: width * height }, (_, at) => view.getUint16(2 * at));
  }
  const length = Math.ceil((width * bits) / 8);
  return Uint8Array.from({ length: width * height }, (_, at) => {
    const bit = (at % width) * bits;
    const byte = rows[Math.floor(at / width) * length + (bit >> 3)];
    return (byte >> (8 - bits - (bit & 7))) & ((1 << bits) - 1);
  });
}
