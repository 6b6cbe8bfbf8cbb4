// Curves over the frames, linked with the slider, and the strip that shows where the camera was lost.

const LOST = -1, OTHER_MAP = -2, NOT_USED = -3, ROTATED = -4;
const LINE_COLOURS = { light: ["#1c5fb0", "#c2410c", "#157347"], dark: ["#7db4ff", "#ff9d66", "#58d093"] };
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const kindOf = (place) => (place === 0 ? "in" : place > 0 || place === OTHER_MAP ? "other" : place === LOST ? "lost" : place === ROTATED ? "rotated" : "skipped");

// Return [first, last, kind] of each segment of frames of one kind.
function segments(places) {
  const found = [];
  for (let i = 0; i < places.length; i++) {
    const kind = kindOf(places[i]), last = found[found.length - 1];
    if (last && last[2] === kind) last[1] = i;
    else found.push([i, i, kind]);
  }
  return found;
}

function sharpCanvas(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2), [width, height] = [canvas.clientWidth, canvas.clientHeight];
  Object.assign(canvas, { width: Math.max(1, width * ratio), height: Math.max(1, height * ratio) });
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  return { context, width, height };
}

function drawStrip(canvas, run) {
  const { context, width, height } = sharpCanvas(canvas), count = Math.max(run.worlds.length, 1);
  const colours = { in: style("--in"), other: style("--other"), lost: style("--lost"), rotated: style("--rotated"), skipped: style("--line") };
  for (const [first, last, kind] of segments(run.worlds)) {
    context.fillStyle = colours[kind];
    context.fillRect((first / count) * width, 0, Math.max(1, ((last + 1 - first) / count) * width), height);
  }
}

const short = (value) => (Number.isFinite(value) ? (Math.abs(value) >= 100 ? value.toFixed(0) : Number(value.toPrecision(3)).toString()) : "–");

// Return three round numbers at most between two limits.
function ticks(low, high) {
  const rough = (high - low) / 2, power = 10 ** Math.floor(Math.log10(rough || 1));
  const step = [1, 2, 2.5, 5, 10].map((d) => d * power).find((d) => d >= rough) || power, found = [];
  for (let t = Math.ceil(low / step) * step; t <= high + 1e-9 * step; t += step) found.push(Math.abs(t) < 1e-9 * step ? 0 : t);
  return found;
}

// The curves of a run: title, unit, and lines [name, values].
function curvesOf(run) {
  const { count } = run.worlds.length ? { count: run.worlds.length } : { count: 0 };
  const positions = [0, 1, 2].map(() => new Float32Array(count).fill(NaN)), rotations = positions.map((p) => p.slice());
  const firsts = new Map();
  for (let row = 0; row < count; row++) {
    const pose = run.poseOf(row);
    if (!pose) continue;
    if (!firsts.has(run.worlds[row])) firsts.set(run.worlds[row], transposed(pose.R));
    const turn = rotationVector(product(firsts.get(run.worlds[row]), pose.R));
    for (let k = 0; k < 3; k++) [positions[k][row], rotations[k][row]] = [pose.t[k], turn[k]];
  }
  const axes = (values) => values.map((line, k) => ["xyz"[k], line]);
  return [
    { title: "Camera position", unit: run.scale_known ? "mm" : "size unknown", lines: axes(positions) },
    { title: "Camera rotation", unit: "degrees", lines: axes(rotations) },
    { title: "How well followed", unit: "1 is best", lines: [["inliers", run.curves.inliers], ["correlation", run.curves.agreement]] },
    { title: "Tissue that moves on its own", unit: "share of the picture", lines: [["", run.curves.moving]] },
    { title: "Sharpness", unit: "more is sharper", lines: [["", run.curves.sharpness]] },
    { title: "Scale of depth", unit: "level is good", lines: [["", run.curves.scale]] },
    { title: "Time per frame", unit: "ms", lines: [["", run.curves.ms]], cut: 0.99 },
  ];
}

function limits({ lines, cut }) {
  let known = lines.flatMap(([, values]) => Array.from(values).filter(Number.isFinite));
  if (!known.length) return null;
  known.sort((a, b) => a - b);
  const low = known[0], high = known[Math.floor((known.length - 1) * (cut || 1))];
  const margin = (high - low || Math.abs(high) || 1) * 0.06;
  return [low - margin, high + margin];
}

class Curve {
  constructor(box, run, curve, choose) {
    Object.assign(this, { run, curve, range: limits(curve) });
    const holder = document.createElement("div"), heading = document.createElement("h3");
    holder.className = "curve";
    heading.textContent = curve.title;
    const unit = document.createElement("span");
    unit.textContent = curve.unit;
    heading.append(unit);
    this.names = curve.lines.filter(([name]) => name).map(([name]) => {
      const label = document.createElement("i");
      label.textContent = name;
      heading.append(label);
      return label;
    });
    this.value = document.createElement("span");
    this.value.style.marginLeft = "auto";
    heading.append(this.value);
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    const told = this.range ? `from ${short(this.range[0])} to ${short(this.range[1])}` : "not kept";
    this.canvas.setAttribute("aria-label", `${curve.title}, ${curve.unit}, over all frames, ${told}`);
    holder.append(heading, this.canvas);
    box.append(holder);
    const pick = (event) => {
      const box = this.canvas.getBoundingClientRect(), share = (event.clientX - box.left - 34) / (box.width - 40);
      choose(Math.round(Math.max(0, Math.min(1, share)) * (run.worlds.length - 1)));
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      pick(event);
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => event.buttons && pick(event));
  }

  draw(row) {
    const { context, width, height } = sharpCanvas(this.canvas), count = this.run.worlds.length;
    const colours = LINE_COLOURS[document.documentElement.dataset.theme === "dark" ? "dark" : "light"];
    const x = (i) => 34 + (count > 1 ? (i / (count - 1)) * (width - 40) : 0);
    context.globalAlpha = 0.2;
    for (const [first, last, kind] of segments(this.run.worlds)) {
      if (kind === "in") continue;
      context.fillStyle = style(kind === "lost" ? "--lost" : kind === "rotated" ? "--rotated" : kind === "other" ? "--other" : "--soft");
      context.fillRect(x(first) - 0.5, 0, Math.max(1, x(last) - x(first) + 1), height);
    }
    context.globalAlpha = 1;
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = style("--soft");
    if (!this.range) return context.fillText("not kept in this run", 44, height / 2);
    const [low, high] = this.range, y = (value) => height - 6 - ((value - low) / (high - low)) * (height - 12);
    context.strokeStyle = style("--line");
    context.textAlign = "right";
    for (const tick of ticks(low, high)) {
      context.fillText(short(tick), 30, y(tick) + 4);
      context.strokeRect(34, y(tick), width - 40, 0);
    }
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    this.curve.lines.forEach(([, values], k) => this.#line(context, values, colours[k], x, y));
    context.strokeStyle = style("--now");
    context.lineWidth = 2;
    context.strokeRect(x(row), 0, 0, height);
    this.value.textContent = this.curve.lines.map(([, values]) => short(values[row])).join("  ");
    this.names.forEach((label, k) => (label.style.color = colours[k]));
    return null;
  }

  // Of many frames, a column of pixels shows the lowest and the highest value.
  #line(context, values, colour, x, y) {
    const every = Math.max(1, Math.floor(values.length / 1500));
    context.strokeStyle = context.fillStyle = colour;
    context.beginPath();
    let drawing = false;
    for (let i = 0; i < values.length; i += every) {
      const some = Array.from(values.subarray(i, i + every)).filter(Number.isFinite);
      if (!some.length || this.run.worlds[i] !== this.run.worlds[Math.max(i - every, 0)]) drawing = false;
      if (!some.length) continue;
      for (const value of every > 1 ? [Math.min(...some), Math.max(...some)] : some) {
        if (drawing) context.lineTo(x(i), y(value));
        else context.moveTo(x(i), y(value));
        drawing = true;
      }
      const alone = !Number.isFinite(values[i + every]) && !Number.isFinite(values[i - every]);
      if (alone) context.fillRect(x(i) - 1, y(some[0]) - 1, 2, 2);
    }
    context.stroke();
  }
}
