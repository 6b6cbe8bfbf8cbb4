// The page: what is chosen, and who draws it.

const data = JSON.parse(document.getElementById("data").textContent);
const turbo = new Uint8Array(bytesOf(data.turbo)), ramp = new Uint8Array(bytesOf(data.ramp));
const element = (id) => document.getElementById(id);
const root = document.documentElement;
const FIELD_OF_VIEW = 0.8;
let run, panels, curves, view = null, row = 0, shown = 0, turn = { yaw: 0, pitch: 0, distance: 1, shift: [0, 0, 0] }, images = null, playing = null, due = false;

function prepared(raw) {
  const frames = raw.frames, floats = (text) => new Float32Array(bytesOf(text)), poses = new Float64Array(bytesOf(frames.pose));
  const places = new Int16Array(bytesOf(frames.place)), curves = {};
  for (const [name, text] of Object.entries(frames.curves)) curves[name] = floats(text);
  const poseOf = (i) => {
    const p = poses.subarray(12 * i, 12 * i + 12);
    return Number.isFinite(p[0]) ? { R: [p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10]], t: [p[3], p[7], p[11]] } : null;
  };
  // Segments of the result share its world; submaps have their own.
  const worlds = places.map((place) => (place > 0 && raw.titles[place].folder === "." ? 0 : place));
  return {
    ...raw, places, worlds, curves, poseOf, reasons: frames.reasons, indices: new Int32Array(bytesOf(frames.index)), times: floats(frames.time_s),
    reasonOf: new Int16Array(bytesOf(frames.reason)), causes: frames.causes, causeOf: new Int8Array(bytesOf(frames.cause)), truth: raw.truth && { ...raw.truth, positions: floats(raw.truth.positions) },
  };
}

// The ball around a map's surface and path: centre and radius.
function ball(number) {
  const map = run.maps[number], low = map.vertices ? [...map.low] : [Infinity, Infinity, Infinity], high = low.map((v, k) => (map.vertices ? map.high[k] : -Infinity));
  run.places.forEach((place, i) => {
    const pose = place === number && run.poseOf(i);
    if (pose) pose.t.forEach((value, k) => ((low[k] = Math.min(low[k], value)), (high[k] = Math.max(high[k], value))));
  });
  const centre = low.map((value, k) => (value + high[k]) / 2);
  return { centre, radius: Math.max(Math.hypot(...high.map((value, k) => value - low[k])) / 2, 1e-6) };
}

function colour(name) {
  const hex = style(name);
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);
}

// The path of the shown map; where frames are missing between two of its frames, a dashed line.
function pathLines() {
  const rows = [];
  run.places.forEach((place, i) => place === shown && run.poseOf(i) && rows.push(i));
  const every = Math.max(1, Math.floor(rows.length / 4000)), lines = [], [followed, lost, truth] = ["--in", "--lost", "--truth"].map(colour);
  for (let k = every; k < rows.length; k += every) {
    const missing = run.places.subarray(rows[k - every] + 1, rows[k]).some((place) => place !== NOT_USED && place !== shown);
    lines.push({ from: run.poseOf(rows[k - every]).t, to: run.poseOf(rows[k]).t, colour: missing ? lost : followed, dashed: missing });
  }
  const true_ = shown === 0 && run.truth ? run.truth.positions : [];
  for (let k = 3; k < true_.length; k += 3) lines.push({ from: true_.slice(k - 3, k), to: true_.slice(k, k + 3), colour: truth });
  return lines;
}

// Corners of the camera's picture at a distance in front of it.
function cornersOf(pose, distance) {
  const c = run.camera, at = (u, v) => add(pose.t, rotated(pose.R, [((u - c.cx) / c.fx) * distance, ((v - c.cy) / c.fy) * distance, distance]));
  return [at(-0.5, -0.5), at(c.width - 0.5, -0.5), at(-0.5, c.height - 0.5), at(c.width - 0.5, c.height - 0.5)];
}

function frustumLines(pose, corners) {
  const now = colour("--now"), order = [[0, 1], [1, 3], [3, 2], [2, 0]];
  return [...corners.map((corner) => ({ from: pose.t, to: corner, colour: now })), ...order.map(([a, b]) => ({ from: corners[a], to: corners[b], colour: now }))];
}

// Where one looks from: around the surface, or along with the camera.
function eye(pose) {
  const { centre, radius } = run.balls[shown], look = element("look").value, along = look !== "overview" && pose;
  const R = product(along ? pose.R : IDENTITY, turned(turn.yaw, turn.pitch));
  const target = add(along ? pose.t : centre, turn.shift);
  const { clientWidth, clientHeight } = element("scene"), fit = Math.min(1, Math.max(0.72, (1.05 * clientHeight) / clientWidth));
  const away = !along ? (fit * radius) / Math.sin(FIELD_OF_VIEW / 2) : look === "behind" ? 0.5 * radius : 0.002 * radius;
  const through = along && look === "through";
  return { R, t: add(target, scaled(column(R, 2), -away * turn.distance)), through, fieldOfView: through ? 1.2 : FIELD_OF_VIEW };
}

function drawScene() {
  due = false;
  if (!view) return;
  const pose = run.places[row] === shown ? run.poseOf(row) : null, from = eye(pose), { radius, centre } = run.balls[shown];
  const distance = Math.hypot(...add(from.t, scaled(centre, -1))), corners = pose && cornersOf(pose, 0.16 * radius);
  writeSceneScale(from, distance);
  view.background = colour("--scene");
  view.paint = Number(element("paint").value);
  view.cut = element("cut").checked;
  view.pale = data.pale;
  const near = Math.max(0.004 * radius, distance - 2 * radius);
  view.draw(run.maps[shown], from, {
    near, far: distance + 3 * radius, fieldOfView: from.fieldOfView, lines: [...pathLines(), ...measuredLines()],
    frustum: [...(corners && !from.through ? frustumLines(pose, corners) : []), ...markedLines()], corners: from.through ? null : corners,
  });
  root.dataset.frustum = pose ? pose.t.map((value) => value.toFixed(4)).join(" ") : "";
}

function redraw() {
  if (!due) requestAnimationFrame(drawScene);
  due = true;
}

async function setRow(next) {
  row = Math.max(0, Math.min(run.places.length - 1, next));
  const at = row, place = run.places[row], picture = panels.nearest(row), map = place >= 0 && place < run.maps.length ? place : shown;
  if (map !== shown) showMap(map);
  element("slider").value = row;
  const time = `${run.times[row].toFixed(2)} s`, status = statusOf(run, row);
  element("slider").setAttribute("aria-valuetext", `frame ${run.indices[row]}, ${time}, ${status}`);
  put("frame-title", `Frame ${run.indices[row]} · ${time}`);
  put("frame-status", status[0].toUpperCase() + status.slice(1));
  element("frame-status").dataset.place = kindOf(run.worlds[row]);
  curves.forEach((curve) => curve.draw(row));
  redraw();
  const near = picture && Math.abs(picture.row - row) <= run.spacing ? picture : null, decoded = near && (await panels.decode(near));
  if (at !== row) return;
  images = decoded;
  // The pictures are those of the nearest frame that was kept, and so is the pose that they are compared at.
  panels.shown = near;
  const of = near ? near.row : row, pose = run.places[of] === shown ? run.poseOf(of) : null;
  put("video-note", near && near.row !== row ? `of frame ${run.indices[near.row]}` : "");
  view?.setPicture(images ? images.video : null);
  const median = panels.draw(images, run.maps[shown], view && pose, { showMask: element("mask").checked, far: 8 * run.balls[shown].radius + 2 * run.depth_range[1] });
  markPictures();
  panels.drawScale();
  put("residual-note", median === null ? "" : `differs by ${(100 * median).toFixed(1)} %`);
  redraw();
  root.dataset.shown = String(row);
}

function showMap(number) {
  shown = number;
  turn = { yaw: -0.7, pitch: -0.4, distance: 1, shift: [0, 0, 0] };
  put("submap", run.maps.length > 1 ? run.titles[number].name + (number && !isSegment(run, number) ? ": relative pose unknown" : "") : "");
  document.querySelectorAll("#submap-list button").forEach((button) => button.setAttribute("aria-pressed", String(Number(button.dataset.map) === number)));
  writeLegend();
}

const rampStops = (levels) => [0, 32, 64, 96, 128, 160, 192, 224, 255].map((k) => `rgb(${levels.subarray(3 * k, 3 * k + 3).join(" ")})`);

function writeLegend() {
  const paint = Number(element("paint").value), found = legendOf(run, run.maps[shown], paint);
  const words = paint === 0 ? [data.pale.words] : [];
  element("scene-legend").replaceChildren(...(found ? [colourBar(rampStops(ramp), found[0]), found[1]] : words));
}

// What the colours of depth and of its difference are in numbers; without a scale in multiples of the nearest depth.
function writeScales() {
  const [near, far] = run.depth_range, of = (share) => near * (far / near) ** share, unit = run.scale_known ? 1 : near;
  const numbers = [0, 0.5, 1].map((share) => [share, short(of(share) / unit)]);
  element("depth-note").replaceChildren(colourBar(rampStops(turbo).reverse(), numbers), run.scale_known ? "mm" : "× the nearest");
  const shares = [-DIFFERENCE_LIMIT, 0, DIFFERENCE_LIMIT], stops = shares.map((share) => `rgb(${differenceColour(share).map(Math.round).join(" ")})`);
  element("residual-scale").replaceChildren(colourBar(stops, shares.map((share, k) => [k / 2, String(100 * share)])), "%");
}

// How long so many mm are, where sizes are known: at a distance, or through the camera at its frame's median depth.
function writeSceneScale(from, distance) {
  const { clientWidth, clientHeight } = element("scene"), away = from.through ? panels.medianMm : distance;
  const pxPerMm = lensOf(clientWidth, clientHeight, from.fieldOfView).fx / away;
  element("scene-scale").hidden = !run.scale_known || !away;
  if (element("scene-scale").hidden) return;
  const mm = roundLength(pxPerMm, 110);
  document.querySelector("#scene-scale .rule").style.width = `${mm * pxPerMm}px`;
  put("scene-scale-note", `${short(mm)} mm at ${from.through ? `${short(away)} mm` : "the middle of the surface"}`);
}

function writeSubmaps() {
  element("submap-list").hidden = run.maps.length < 2;
  element("apart").hidden = !run.titles.some(({ folder }) => folder !== ".");
  element("in-time").hidden = !isSegment(run, 0);
  const buttons = run.maps.map((map, number) => {
    const button = document.createElement("button"), canvas = document.createElement("canvas"), first = run.places.indexOf(number);
    const note = document.createElement("small");
    button.type = "button";
    button.dataset.map = String(number);
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Surface: ${run.titles[number].name}`);
    const word = number || isSegment(run, 0) ? `verdict: ${run.titles[number].word}` : "", parts = number && isSegment(run, number) ? "" : partsInWords(run, number);
    note.textContent = [word, `${map.frames} frames`, parts, map.inliers].filter(Boolean).join(", ");
    const pair = document.createElement("span"), seen = run.pictures.filter((picture) => run.places[picture.row] === number);
    pair.className = "pair";
    pair.append(canvas);
    if (seen.length) pair.append(Object.assign(new Image(), { src: `data:image/jpeg;base64,${seen[seen.length >> 1].jpg}`, alt: "a frame of this submap" }));
    button.append(pair, run.titles[number].name, note);
    button.addEventListener("click", () => (showMap(number), setRow(first)));
    if (view && map.vertices) {
      const { centre, radius } = run.balls[number], R = turned(-0.7, -0.4), t = add(centre, scaled(column(R, 2), -2.2 * radius)), lens = lensOf(320, 240, 0.9);
      dimensioned(canvas, 320, 240).putImageData(new ImageData(view.pixels(map, { R, t }, lens, 0.05 * radius, 9 * radius, { cut: true }), 320, 240), 0, 0);
      if (run.scale_known) drawScaleBar(canvas, lens.fx / (2.2 * radius), "at its middle");
    }
    return button;
  });
  element("submap-list").replaceChildren(...buttons.sort((one, other) => run.maps[one.dataset.map].turn - run.maps[other.dataset.map].turn));
}

const MOST_LOSSES = 12;

// The longest segments, in the order of the video.
function writeLosses() {
  const all = run.losses, shortest = all.map((loss) => loss.frames).sort((a, b) => b - a)[MOST_LOSSES - 1] || 0;
  const kept = all.filter((loss) => loss.frames >= shortest).slice(0, MOST_LOSSES), left = all.length - kept.length;
  element("losses").hidden = !all.length;
  element("loss-list").replaceChildren(...kept.map((loss) => {
    const item = document.createElement("li"), button = document.createElement("button"), advice = document.createElement("span");
    button.type = "button";
    button.textContent = `${loss.when} (${loss.frames} ${loss.frames === 1 ? "frame" : "frames"}): ${loss.cause || "cause unknown"}`;
    advice.textContent = loss.advice;
    button.addEventListener("click", () => setRow(loss.row));
    item.append(button, advice);
    return item;
  }));
  put("more-losses", left ? `${left} shorter gaps are in frames.csv.` : "");
}

// Share not seen, its map, and the blind spots, as `scopemap coverage` wrote them beside the result.
function writeCoverage() {
  const found = run.coverage;
  element("coverage").hidden = !found;
  if (!found) return;
  const { share, area, start, end } = found.total, lumen = found.kind === "lumen", digits = (value) => Number(value.toPrecision(2));
  // Without a scale lengths say nothing: places are shares of the examined length.
  const along = (place) => (!lumen ? `${Math.round(place)} degrees` : found.unit === "mm" ? `${Math.round(place)} mm` : `${Math.round((100 * (place - start)) / (end - start))} % of the examined length`);
  put("coverage-share", found.statement);
  put("coverage-basis", `These are estimates, calibrated on synthetic ${lumen ? "colons" : "cavities"} (docs/coverage.md).`);
  element("spot-words").hidden = !found.blind_spots.length;
  element("coverage-map").src = `data:image/png;base64,${found.map}`;
  element("spot-list").replaceChildren(...found.blind_spots.map((spot, n) => {
    const item = document.createElement("li"), button = document.createElement("button");
    const where = spot.clock === null ? "all round" : `${Math.round(spot.clock) || 12} o'clock`;
    button.type = "button";
    button.textContent = `${n + 1}. ${digits(Math.min(100, (100 * spot.area) / (share * area)))} % of what was not seen, at ${along(spot.along)}, ${where}: second ${spot.time_s.toFixed(1)}`;
    button.addEventListener("click", () => (mark(spot.position_mm, 0), setRow(run.indices.indexOf(spot.frame)), element("surface").scrollIntoView({ block: "nearest" })));
    item.append(button);
    return item;
  }));
}

function open(number) {
  run = prepared(data.runs[number]);
  run.licences = data.licences;
  run.balls = run.maps.map((_, k) => ball(k));
  run.spacing = run.pictures.length > 1 ? Math.max(...run.pictures.slice(1).map((picture, k) => picture.row - run.pictures[k].row)) : 0;
  panels = new FramePanels(run, view, turbo);
  put("name", run.name);
  writeVerdict(run);
  writeDetails(run);
  writeSubmaps();
  writeLosses();
  writeCoverage();
  element("truth-key").hidden = !run.truth;
  writeScales();
  if (data.runs.length === 1) document.querySelectorAll("a[data-file]").forEach((link) => (link.href = link.textContent));
  else element("beside").hidden = true;
  element("curves").replaceChildren();
  curves = curvesOf(run).map((curve) => new Curve(element("curves"), run, curve, setRow));
  element("slider").max = run.places.length - 1;
  showMap(0);
  drawStrip(element("strip"), run);
  openAtlas(run, setRow);
  row = run.opens_at;
  writeMeasured();
  setRow(row);
}

function setTheme(dark) {
  root.dataset.theme = dark ? "dark" : "light";
  element("theme").setAttribute("aria-pressed", String(dark));
  put("theme", dark ? "Light" : "Dark");
  if (!run) return;
  drawStrip(element("strip"), run);
  drawAtlas(element("atlas"), run);
  setRow(row);
}

function play() {
  const stop = playing !== null;
  clearInterval(playing);
  playing = stop ? null : setInterval(() => setRow(row + 1 < run.places.length ? row + Math.max(1, Math.round(run.places.length / 400)) : 0), 80);
  put("play", stop ? "▶" : "❚❚");
  element("play").setAttribute("aria-label", stop ? "Play" : "Pause");
}
