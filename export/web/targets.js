// The numbers of a layer as a target: rings by distance, sectors by direction.

/** What `default` counts: the areas of layers of one or two categories, and boundaries. */
const AREAS = [["ground", "parking"], ["sidewalk"], ["building", "guard-rail"], ["pole"], ["vegetation"], ["sky"]];
const BOUNDARIES = ["upright", "level", "rising", "falling"].map((direction) => [`${direction} boundaries`]);

/** A target of each layer, ``{names, rings, sectors, values, turned}``; values ring by ring. The centre
 * of a soft sector is its angle, so the target is turned back by half a sector. */
export function targetsOf(config, descriptor, categories) {
  const { rings, sectors } = config;
  let start = 0;
  const next = (length) => descriptor.subarray(start, (start += length));
  if (config.aggregation === "residuals")
    return categories.map((name) => {
      return { names: [name], rings, sectors, values: next(rings * sectors), turned: 0 };
    });
  const smooth = (length) => (names) => {
    return { names, rings, sectors, values: histogramOf(config, next(length)), turned: 0.5 };
  };
  return [...AREAS.map(smooth(config.harmonics)), ...BOUNDARIES.map(smooth(config.boundary_harmonics))];
}

/** The smooth part of the histogram, up to a factor; the numbers are its coefficients. */
function histogramOf({ rings, sectors, power, spectral_weight }, numbers) {
  const values = new Float64Array(rings * sectors);
  wavesOf(rings, sectors)
    .slice(0, numbers.length)
    .forEach(({ u, v, phase }, i) => {
      const coefficient = Math.sign(numbers[i]) * Math.abs(numbers[i]) ** (1 / power);
      const wave = values.map((_, bin) => {
        const [ring, sector] = [Math.floor(bin / sectors), bin % sectors];
        const outward = Math.cos((Math.PI * u * (ring + 0.5)) / rings);
        return outward * Math.cos((2 * Math.PI * v * sector) / sectors - phase);
      });
      const weight = (1 + u * u + v * v) ** (spectral_weight / 2);
      wave.forEach((height, bin) => (values[bin] += (coefficient * height) / weight / Math.hypot(...wave)));
    });
  return values;
}

/** Basis functions in the order of `stages.harmonics.waves`. */
function wavesOf(rings, sectors) {
  const waves = [];
  for (let u = 0; u < rings; u++)
    for (let v = 0; v < (sectors + 1) >> 1; v++)
      for (const phase of v ? [0, Math.PI / 2] : [0]) waves.push({ u, v, phase });
  const frequency = ({ u, v }) => u * u + v * v;
  return waves.sort(
    (a, b) => frequency(a) - frequency(b) || a.u - b.u || a.v - b.v || a.phase - b.phase,
  );
}

/** Draws a target: red above zero, blue below, white zero. */
export function drawTarget(canvas, { rings, sectors, values, turned }) {
  const context = canvas.getContext("2d");
  const middle = canvas.width / 2;
  const largest = values.reduce((high, value) => Math.max(high, Math.abs(value)), 0);
  context.clearRect(0, 0, canvas.width, canvas.height);
  for (let ring = rings - 1; ring >= 0; ring--) {
    for (let sector = 0; sector < sectors; sector++) {
      const value = values[ring * sectors + sector];
      const angles = [0, 1].map((end) => (2 * Math.PI * (sector - turned + end)) / sectors);
      context.beginPath();
      context.moveTo(middle, middle);
      context.arc(middle, middle, ((middle - 1) * (ring + 1)) / rings, ...angles);
      context.closePath();
      context.fillStyle = colourOf(largest ? value / largest : 0);
      context.fill();
      context.strokeStyle = "#8886";
      context.lineWidth = 0.5;
      context.stroke();
    }
  }
}

function colourOf(fraction) {
  const end = fraction > 0 ? [178, 24, 43] : [33, 102, 172];
  const parts = end.map((part) => Math.round(255 + (part - 255) * Math.abs(fraction)));
  return `rgb(${parts.join(" ")})`;
}
