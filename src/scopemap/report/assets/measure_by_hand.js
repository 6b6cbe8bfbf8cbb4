// Points picked in the frame's pictures or on the surface, what is measured between them, and the list that is kept.

const hand = { mode: "", picks: [], reference: null, list: [] };
const rounded3 = (value) => (value === null ? "none: the surface has a gap" : String(Number(value.toPrecision(3))));
const rounded = (pixel) => pixel.map((value) => Math.round(100 * value) / 100);
const inWords = (pixels) => pixels.map((pixel) => pixel.join(",")).join(" ");
const tell = (text) => put("hand-note", text);
const lengthOf = (one) => (one.reference_mm === null ? "of unknown length" : `${one.reference_mm} mm long`);
const valueIn = (f) => {
  if (f.value === null) return rounded3(f.value);
  if (f.low === 0) return `not measurable (0 to ${rounded3(f.high)} ${f.unit})`;
  return `${rounded3(f.value)} ${f.unit} (${rounded3(f.low)} to ${rounded3(f.high)})`;
};
const foundIn = (one) => one.found.map((f) => `${f.what}: ${valueIn(f)}`).join("; ");
const wordsOf = (one) => (one.kind === "reference" ? `Reference, ${lengthOf(one)}, in frame ${one.frame}` : `${one.name ? `${one.name}, frame` : "Frame"} ${one.frame}: ${foundIn(one)}`);

// A picture's frame for `measured`, with its depth and its standard deviation at a pixel, NaN where unknown.
async function measuredFrame(picture) {
  const { depth } = await panels.decode(picture), camera = run.camera, map = run.maps[run.places[picture.row]];
  const bytes = depth && bytesOfImage(depth, depth.width, depth.height);
  const depthAt = ([x, y]) => {
    if (!depth) return [NaN, NaN];
    const at = 4 * (Math.floor((y + 0.5) * (depth.height / camera.height)) * depth.width + Math.floor((x + 0.5) * (depth.width / camera.width)));
    const units = 256 * bytes[at] + bytes[at + 1], own = units ? Math.fround(units * run.depth_unit_mm) : NaN;
    return [own, Math.fround((run.sigma_shares[bytes[at + 2]] ?? NaN) * own)];
  };
  return { camera, map, depthAt, pose: run.poseOf(picture.row), name: run.indices[picture.row] };
}

// The pixels of points (world) in a picture's frame, or null where it does not see all of them.
function pixelsIn(picture, points) {
  const pose = run.poseOf(picture.row), c = run.camera, surface = surfaceOf(run.maps[run.places[picture.row]]), pixels = [];
  for (const point of points) {
    const [x, y, z] = inCamera(pose, point), pixel = rounded([(x / z) * c.fx + c.cx, (y / z) * c.fy + c.cy]);
    if (!(z > 0 && pixel.every((value, k) => value >= -0.5 && value < [c.width, c.height][k] - 0.5))) return null;
    const found = meet(surface, pose.t, rotated(pose.R, unprojected(c, pixel)));
    if (!found || norm(minus(found.at, point)) > 0.02 * z) return null;
    pixels.push(pixel);
  }
  return pixels;
}

// The picture in which all points were picked, or the nearest in time that sees all of them and the reference, if any;
// with the points' pixels and the reference's.
function seenTogether(picks, reference) {
  const far = (picture) => Math.abs(picture.row - row), same = picks.every(({ picture }) => picture && picture === picks[0].picture);
  const seeing = same ? [picks[0].picture] : run.pictures.filter((one) => run.places[one.row] === shown).sort((a, b) => far(a) - far(b));
  for (const picture of seeing) {
    const pixels = same ? picks.map(({ pixel }) => pixel) : pixelsIn(picture, picks.map(({ at }) => at));
    const known = pixels && reference && run.places[reference.picture.row] === shown && (reference.picture === picture ? reference.pixels : pixelsIn(picture, reference.at));
    if (pixels && (known || !reference)) return [picture, pixels, known];
  }
  throw new Error(same ? "this frame does not see the reference" : `no frame with a picture sees all of these points${reference ? " and the reference" : ""}`);
}

async function finishPicks() {
  const { mode, picks, reference } = hand;
  if (picks.length < (mode === "area" ? 3 : 2)) return tell("An area needs at least three points.");
  hand.picks = [];
  tell("Measuring …");
  try {
    const [picture, pixels, known] = seenTogether(picks, mode === "reference" ? null : reference);
    const frame = await measuredFrame(picture), points = picks.map(({ at }) => at);
    if (mode === "reference") {
      checkReference(pixels, frame.map.errors);
      hand.reference = { picture, pixels, at: points };
      tell(`The reference is set in frame ${frame.name}. Now choose Distance or Area, and measure in a frame that also shows it.`);
    } else {
      const mm = (reference && Math.max(0, element("reference-mm").value)) || null, number = run.places[picture.row];
      const found = measured(frame, pixels, known, mm).map((one) => ({ ...one, value: Number.isFinite(one.value) ? one.value : null }));
      const more = known ? ` --reference "${inWords(known)}"${mm ? ` --reference-mm ${mm}` : ""}` : "", { folder } = run.titles[number];
      const command = `scopemap measure ${folder} --frame ${frame.name} --points "${inWords(pixels)}"${more}`;
      hand.list.push({ folder, frame: frame.name, points: pixels, reference: known, reference_mm: mm, found, command, world: points });
      tell(wordsOf(hand.list.at(-1)));
    }
  } catch (fault) {
    tell(`Not measured: ${fault.message}.`);
  }
  writeMeasures();
}

function pick(one) {
  if (!one) return tell("There is no surface here.");
  hand.picks.push(one);
  tell(`${hand.picks.length} ${hand.picks.length === 1 ? "point" : "points"}${hand.mode === "area" ? "; Enter or “Close” ends the polygon" : ""}`);
  if (hand.mode !== "area" && hand.picks.length === 2) finishPicks();
  else writeMeasures();
}

function pickInFrame(event) {
  if (!hand.mode) return;
  const canvas = event.currentTarget, box = canvas.getBoundingClientRect(), picture = panels.shown;
  if (!picture || run.places[picture.row] !== shown) return tell("This frame has no pose: nothing can be measured in it.");
  const zoom = Math.min(box.width / canvas.width, box.height / canvas.height), c = run.camera; // object-fit: contain
  const at = (client, start, size, pixels, all) => ((client - start - (size - pixels * zoom) / 2) / zoom) * (all / pixels) - 0.5;
  const pixel = rounded([at(event.clientX, box.left, box.width, canvas.width, c.width), at(event.clientY, box.top, box.height, canvas.height, c.height)]);
  if (!pixel.every((value, k) => value >= -0.5 && value < [c.width, c.height][k] - 0.5)) return;
  const pose = run.poseOf(picture.row), found = meet(surfaceOf(run.maps[shown]), pose.t, rotated(pose.R, unprojected(c, pixel)));
  pick(found && { picture, pixel, at: found.at });
}

function pickOnSurface(event) {
  const scene = element("scene"), box = scene.getBoundingClientRect(), from = eye(run.places[row] === shown ? run.poseOf(row) : null);
  const ray = unprojected(lensOf(box.width, box.height, from.fieldOfView), [event.clientX - box.left - 0.5, event.clientY - box.top - 0.5]);
  const found = meet(surfaceOf(run.maps[shown]), from.t, rotated(from.R, ray), element("cut").checked);
  pick(found && { at: found.at });
}

const outlineOf = (points) => (points.length > 2 ? [...points, points[0]] : points);

// A cross at a point, as lines of the scene.
const crossAt = (at, size, ink) => [[1, 1, 0], [1, -1, 0], [0, 1, 1]].map((way) => ({ from: add(at, scaled(way, size)), to: add(at, scaled(way, -size)), colour: ink }));

// What was picked and measured, as lines of the scene.
function handLines() {
  const number = (one) => (one.folder === "." ? 0 : Number(one.folder.split("/")[1])), ink = colour("--hand");
  const shapes = [hand.picks.map(({ at }) => at), ...hand.list.filter((one) => number(one) === shown).map((one) => outlineOf(one.world))];
  const size = 0.012 * run.balls[shown].radius;
  const crosses = shapes.flat().flatMap((at) => crossAt(at, size, ink));
  return [...crosses, ...shapes.flatMap((points) => points.slice(1).map((to, k) => ({ from: points[k], to, colour: ink })))];
}

// The same in the pictures of the frame that it was measured in.
function markPictures() {
  const picture = panels.shown, c = run.camera, place = ([x, y]) => [((x + 0.5) * panels.size[0]) / c.width, ((y + 0.5) * panels.size[1]) / c.height];
  if (!picture) return;
  const index = run.indices[picture.row], same = (one) => one.frame === index, shapes = hand.list.filter(same).map((one) => outlineOf(one.points));
  shapes.push(hand.picks.filter((one) => one.picture === picture).map(({ pixel }) => pixel));
  if (hand.reference?.picture === picture) shapes.push(hand.reference.pixels);
  for (const canvas of panels.drawn) {
    const context = canvas.getContext("2d");
    for (const [ink, wide] of [["#000", 3], ["#fff", 1.4]]) for (const shape of shapes) {
      Object.assign(context, { strokeStyle: ink, lineWidth: wide });
      context.beginPath();
      shape.map(place).forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
      shape.map(place).forEach(([x, y]) => (context.moveTo(x - 4, y), context.lineTo(x + 4, y), context.moveTo(x, y - 4), context.lineTo(x, y + 4)));
      context.stroke();
    }
  }
}

function csvOf() {
  const cell = (value) => `"${String(value ?? "").replaceAll('"', '""')}"`;
  const number = (value) => (value === null ? "" : Number(value.toPrecision(3)));
  const rows = hand.list.flatMap((one, n) => one.found.map((f) => [n + 1, one.folder, one.frame, f.what, number(f.value), number(f.low), number(f.high), f.unit, inWords(one.points)]));
  return [["number", "folder", "frame", "what", "value", "low", "high", "unit", "pixels"], ...rows].map((cells) => cells.map(cell).join(",")).join("\n");
}

function writeMeasures() {
  element("measures").replaceChildren(...hand.list.map((one, n) => {
    const line = document.createElement("li"), remove = document.createElement("button"), code = document.createElement("code");
    code.textContent = one.command;
    remove.textContent = "Remove";
    remove.type = "button";
    remove.addEventListener("click", () => (hand.list.splice(n, 1), writeMeasures()));
    line.append(`${wordsOf(one)} `, remove, code);
    return line;
  }));
  element("csv").value = hand.list.length ? csvOf() : "";
  for (const id of ["csv", "save-json", "copy-csv"]) element(id).hidden = !hand.list.length;
  for (const mode of ["distance", "area", "reference"]) element(`pick-${mode}`).setAttribute("aria-pressed", String(hand.mode === mode));
  element("close-area").hidden = hand.mode !== "area";
  root.dataset.hand = hand.mode;
  root.dataset.measures = String(hand.list.length);
  setRow(row);
}

function saveMeasures() {
  const text = JSON.stringify(hand.list, null, 1), link = document.createElement("a");
  Object.assign(link, { href: URL.createObjectURL(new Blob([text], { type: "application/json" })), download: "measurements.json" });
  link.click();
  tell("Put measurements.json beside report.html: then `scopemap report` and `view` show it again.");
}

// The reference that is kept for the result, where its frame has a picture.
function keptReference() {
  const kept = (run.measurements || []).find((one) => one.kind === "reference" && one.folder === ".");
  const picture = kept && run.pictures.find((one) => run.indices[one.row] === kept.frame);
  if (!picture) return null;
  element("reference-mm").value = kept.reference_mm ?? "";
  return { picture, pixels: kept.points, at: kept.world };
}

function openMeasures() {
  Object.assign(hand, { mode: "", picks: [], reference: keptReference(), list: run.measurements || [] });
  element("by-hand").hidden = !run.measuring || !run.pictures.length;
  writeMeasures();
}

function listenToHand() {
  const choose = (mode) => {
    const without = mode !== "reference" && !run.scale_known && !hand.reference;
    if (mode === "reference" && hand.mode !== mode) hand.reference = null; // chosen anew, or removed by Escape
    Object.assign(hand, { mode: hand.mode === mode || without ? "" : mode, picks: [] });
    tell(without ? "Sizes are unknown: first choose Reference and click the two ends of a distance. Other lengths are given relative to it." : "");
    writeMeasures();
  };
  for (const mode of ["distance", "area", "reference"]) element(`pick-${mode}`).addEventListener("click", () => choose(mode));
  for (const id of ["video", "depth", "rendered", "residual"]) element(id).addEventListener("click", pickInFrame);
  let down = null;
  element("scene").addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
  element("scene").addEventListener("click", (event) => hand.mode && down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4 && pickOnSurface(event));
  element("close-area").addEventListener("click", finishPicks);
  element("save-json").addEventListener("click", saveMeasures);
  element("copy-csv").addEventListener("click", () => (element("csv").select(), document.execCommand("copy"), tell("Copied.")));
  document.addEventListener("keydown", (event) => {
    if (!hand.mode || event.target.matches("input:not([type=range]), textarea, select, button")) return;
    const keys = { Enter: () => hand.mode === "area" && finishPicks(), Escape: () => choose(hand.mode), Backspace: () => (hand.picks.pop(), writeMeasures()) };
    if (keys[event.key]) (event.preventDefault(), keys[event.key]());
  });
}
