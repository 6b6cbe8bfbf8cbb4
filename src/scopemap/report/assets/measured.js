// What was measured by hand in the window: a table, and lines on the surface and in the pictures of its frames.

const rounded3 = (value) => String(Number(value.toPrecision(3)));
const outlineOf = (points) => (points.length > 2 ? [...points, points[0]] : points);
const rowOf = (one) => run.indices.indexOf(one.frame);

// [value, interval] in words; a gap of the surface has no length.
function figureWords({ value, low, high, unit: kept, why }) {
  const unit = kept.replace("mm2", "mm²");
  if (value === null) return ["none: the surface has a gap", ""];
  const interval = low === null ? "" : `${rounded3(low)} to ${rounded3(high)} ${unit}`;
  const cause = why ? `, wide mainly because of ${why}` : "";
  return low === 0 ? ["not measurable", interval + cause] : [`${rounded3(value)} ${unit}`, interval + cause];
}

const referenceWords = (one) => (one.reference_mm === null ? "of unknown length: the unit of sizes" : `${one.reference_mm} mm, as stated`);

// Rows of the table: what, value, interval, for each figure of a measurement.
function figuresOf(one) {
  return one.kind === "reference" ? [["length", referenceWords(one), ""]] : one.found.map((found) => [found.what, ...figureWords(found)]);
}

const titleOf = (one) => one.name || { reference: "Reference", lesion: "Lesion" }[one.kind] || (one.points.length > 2 ? "Area" : "Distance");

// The number that the window and its CSV give a measurement, "1. "; a reference has none.
function numberOf(one) {
  const number = run.measurements.filter(({ kind }) => kind !== "reference").indexOf(one) + 1;
  return number ? `${number}. ` : "";
}

function tableRows(one) {
  const figures = figuresOf(one), button = document.createElement("button"), head = document.createElement("th");
  button.type = "button";
  button.textContent = `${numberOf(one)}${titleOf(one)}, frame ${one.frame}`;
  const isEarlier = run.by_earlier_reference.includes(run.measurements.indexOf(one));
  button.disabled = rowOf(one) < 0; // measured before the result was made again
  button.addEventListener("click", () => (setRow(rowOf(one)), element("surface").scrollIntoView({ block: "nearest" })));
  Object.assign(head, { scope: "rowgroup", rowSpan: figures.length });
  head.append(button, ...(isEarlier ? [" by an earlier reference"] : []));
  return figures.map((cells, k) => {
    const line = document.createElement("tr");
    line.classList.toggle("earlier", isEarlier);
    if (k === 0) line.append(head);
    line.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
    return line;
  });
}

function writeMeasured() {
  const all = run.measurements;
  element("measured").hidden = element("measured-commands").hidden = !all.length;
  document.querySelector("#measured tbody").replaceChildren(...all.flatMap(tableRows));
  put("measured-command-list", all.map(({ command }) => command).filter(Boolean).join("\n"));
}

// What was measured on the shown map, as lines of the scene.
function measuredLines() {
  const shapes = run.measurements.filter((one) => run.places[rowOf(one)] === shown).map(({ world }) => world), ink = colour("--hand");
  const crosses = shapes.flat().flatMap((at) => crossAt(at, 0.012 * run.balls[shown].radius, ink));
  return [...crosses, ...shapes.map(outlineOf).flatMap((points) => points.slice(1).map((to, k) => ({ from: points[k], to, colour: ink })))];
}

// Pixels of what was measured in a picture's frame, or in one whose nearest picture it is.
function measuredShapes(picture) {
  const here = run.measurements.filter((one) => rowOf(one) >= 0 && panels.nearest(rowOf(one)) === picture);
  const seen = here.map((one) => (one.frame === run.indices[picture.row] ? one.points : one.world.map((at) => pixelIn(picture, at)?.pixel)));
  return seen.filter((pixels) => pixels.every(Boolean)).map(outlineOf);
}
