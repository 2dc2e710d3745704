// What was done to find a drive, in the words of `ssrvlad query`.

const FEWEST = 30; // frames of a map that gives a confidence
const BACKWARDS = -1;

/** The steps of `Database.query` in a line; of queries from `columns`, in a map of `references`. */
export function stepsInWords(steps, columns, references) {
  const { standardised, width, weights } = steps;
  const words = [
    standardised ? "standardised" : "not standardised",
    width ? `sweep +-${columns[(columns.length - 1) / 2 + width]} columns` : "no sweep",
    `followed: ${courseInWords(steps)}`,
  ];
  const shares = weights.map(([name, weight]) => `${name} ${weight.toFixed(2)}`);
  if (shares.length > 1) words.push(`fused: ${shares.join(" + ")}`);
  if (references < FEWEST) words.push(`no confidence: ${references} references are too few`);
  return words.join(", ");
}

function courseInWords({ frames, followed, way, rate, streams }) {
  if (!followed) return frames > 1 ? "no, following is no surer" : "no";
  const course = ["offline"];
  if (way === BACKWARDS) course.push("backwards");
  if (rate !== 1) course.push(`at rate ${rate}`);
  if (streams !== 1) course.push(`${streams} streams in turn`);
  return course.join(", ");
}

/** What the scores of candidates are. */
export function scoreInWords({ followed, weights }) {
  return followed ? "Probability" : weights.length > 1 ? "Fused score" : "Cosine";
}
