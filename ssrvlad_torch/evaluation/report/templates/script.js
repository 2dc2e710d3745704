"use strict";
// Marks the threshold of the slider in both charts and shows its figures.
(() => {
  const steps = JSON.parse(document.getElementById("steps").textContent);
  if (!steps.score.length) return;
  const slider = document.getElementById("chosen");
  const outcome = document.getElementById("outcome");

  // Converts values to pixels of a chart, whose data attributes hold its limits and its axes.
  const plane = (name) => {
    const svg = document.getElementById(name);
    const [xLow, xHigh, yLow, yHigh] = svg.dataset.ends.split(" ").map(Number);
    const [left, right, top, bottom] = svg.dataset.frame.split(" ").map(Number);
    return {
      x: (value) => left + ((value - xLow) / (xHigh - xLow)) * (right - left),
      y: (value) => bottom - ((value - yLow) / (yHigh - yLow)) * (bottom - top),
      add: (kind, values) => {
        const mark = svg.appendChild(document.createElementNS(svg.namespaceURI, kind));
        move(mark, { ...values, y1: top, y2: bottom });
        return mark;
      },
    };
  };
  const move = (mark, values) =>
    Object.entries(values).forEach(([name, value]) => mark.setAttribute(name, value));

  const curve = plane("pr"), scores = plane("scores");
  const dot = curve.add("circle", { class: "dot chosen-step", r: 7 });
  const upright = scores.add("line", { class: "upright chosen-step" });

  const follow = () => {
    const [score, precision, recall, accepted] =
      ["score", "precision", "recall", "accepted"].map((name) => steps[name][slider.value]);
    move(dot, { cx: curve.x(recall), cy: curve.y(precision) });
    move(upright, { x1: scores.x(score), x2: scores.x(score) });
    outcome.textContent = `score ${score.toFixed(4)} and above: ${accepted} accepted, ` +
      `precision ${precision.toFixed(3)}, recall ${recall.toFixed(3)}`;
    slider.setAttribute("aria-valuetext", outcome.textContent);
  };
  slider.max = steps.score.length - 1;
  slider.value = steps.start;
  slider.addEventListener("input", follow);
  document.getElementById("chooser").hidden = false;
  follow();
})();
