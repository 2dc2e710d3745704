// Rules of `ssrvlad encode` for the frames of a drive.

const [MAX_ID, MIN_EVEN] = [40, 0.8];

/** Compares two paths: numbers by value, also decimal numbers that are a whole name, and before text. */
export function inOrder(one, other) {
  const [a, b] = [partsOf(one), partsOf(other)];
  for (let at = 0; at < Math.min(a.length, b.length); at++) {
    const [[number, letter], [second, next]] = [a[at], b[at]];
    if (number !== second) return number === null ? 1 : second === null || number < second ? -1 : 1;
    if (letter !== next) return letter - next;
  }
  return a.length - b.length || (one < other ? -1 : one > other ? 1 : 0);
}

/** ``[number, code]`` of each number and each letter in the name of a frame; `null` for what it is not. */
function partsOf(path) {
  const name = path.split("/").pop().replace(/\.\w+$/, "");
  const [, whole, part] = /^(\d+)\.(\d+)$/.exec(name) ?? [];
  const text = whole ? `${whole}.${part.padEnd(20, "0")}` : name.normalize("NFD");
  const parts = text.match(/\d+|\D/gu) ?? [];
  return parts.map((each) => (/\d/.test(each) ? [BigInt(each), null] : [null, each.codePointAt(0)]));
}

/** Whether gray values are a label map: small ids, or 255, in even areas. A dark photograph has noise. */
export function looksLikeLabels(values, width) {
  const ids = new Set(values);
  ids.delete(255);
  if (width < 2 || ids.size < 2 || Math.max(...ids) > MAX_ID) return false;
  let even = 0;
  for (let at = 1; at < values.length; at++) even += at % width > 0 && values[at] === values[at - 1];
  return even > MIN_EVEN * (values.length - values.length / width);
}
