// The whole video: what each second is (in which submap, or lost and why), and which parts of it are joined, how surely.

const CAUSE_TONES = {
  "too dark": "#4a4a55", overexposed: "#d8c27a", "view covered": "#8a6d3b", "contact with the wall": "#b0563f", "no texture": "#c58a74",
  "motion blur": "#8d6bb8", "smoke, fluid or out of focus": "#6f8fae", "fast motion": "#c2559a",
};
const BAND = { top: 78, height: 26 };

// A map, in words: the result, a submap or a segment; where there are several, by itself.
function nameOf(run, number) {
  const { name, word } = run.titles[number];
  return run.titles.length > 1 && (number || isSegment(run, 0)) ? `${name}, by itself ${word}` : name.toLowerCase();
}

const isSegment = (run, number) => run.titles[number].name.startsWith("Segment");

// Segments are as good as the verdict on them; a submap is another world.
function toneOf(run, number) {
  const { level } = run.titles[number];
  return style(isSegment(run, number) ? (level === "good" ? "--in" : `--${level}`) : number ? "--other" : "--in");
}

// What a frame is, in words and as a colour; the same words are the same band.
function whatIs(run, row) {
  const place = run.places[row], cause = run.causes[run.causeOf[row]];
  if (place >= 0) return { text: nameOf(run, place), tone: toneOf(run, place), place };
  if (place === OTHER_MAP) return { text: "submap too short to be kept", tone: style("--line") };
  if (place === NOT_USED) return { text: "left out: repeated, beyond the rate, or of another size", tone: style("--line") };
  return { text: `lost: ${cause || "no cause was kept"}`, tone: CAUSE_TONES[cause] || style(place === ROTATED ? "--rotated" : "--lost") };
}

function bandsOf(run) {
  const bands = [];
  for (let row = 0; row < run.places.length; row++) {
    const what = whatIs(run, row), last = bands[bands.length - 1];
    if (last && last.text === what.text) last.last = row;
    else bands.push({ ...what, first: row, last: row });
  }
  return bands;
}

const joinInWords = ({ loops, inliers }) => [
  loops && `${loops} ${loops === 1 ? "loop" : "loops"}`, Number.isFinite(inliers) && `found again, ${Math.round(100 * inliers)} % inliers`,
].filter(Boolean).join(", ");

// When a submap is seen, and what joins its parts.
function partsInWords(run, number) {
  const own = run.parts.filter((part) => part.submap === number), at = (row) => run.times[row].toFixed(1);
  const words = own.slice(0, 6).map((part) => {
    const surest = [...part.joined].sort((one, other) => other.loops - one.loops || other.inliers - one.inliers)[0];
    return `${at(part.first)} to ${at(part.last)} s` + (surest ? ` (joined: ${joinInWords(surest)})` : "");
  });
  return words.join("; ") + (own.length > 6 ? ` and ${own.length - 6} more parts` : "");
}

function drawAtlas(canvas, run) {
  const { context, width } = sharpCanvas(canvas), count = Math.max(run.places.length, 1), x = (row) => (row / count) * width;
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "center";
  for (const { first, last, tone, place } of run.bands) {
    context.fillStyle = tone;
    context.fillRect(x(first), BAND.top, Math.max(1, x(last + 1) - x(first)), BAND.height);
    if (place === undefined || x(last + 1) - x(first) < 18) continue;
    context.fillStyle = "#fff";
    context.fillText(run.titles[place].short, (x(first) + x(last + 1)) / 2, BAND.top + 17);
  }
  context.strokeStyle = style("--ink");
  for (const part of run.parts) {
    for (const { part: earlier, loops } of part.joined) {
      const from = x((run.parts[earlier].first + run.parts[earlier].last) / 2), to = x((part.first + part.last) / 2);
      context.lineWidth = Math.min(1 + Math.sqrt(loops), 6);
      context.setLineDash(loops ? [] : [4, 3]);
      context.beginPath();
      context.ellipse((from + to) / 2, BAND.top, (to - from) / 2, Math.min(70, 14 + (to - from) / 5), 0, Math.PI, 2 * Math.PI);
      context.stroke();
    }
  }
  context.setLineDash([]);
  context.fillStyle = style("--soft");
  for (const share of [0, 0.25, 0.5, 0.75, 1]) {
    const row = Math.round(share * (count - 1));
    context.textAlign = share === 0 ? "left" : share === 1 ? "right" : "center";
    context.fillText(`${run.times[row].toFixed(1)} s`, share * width, BAND.top + BAND.height + 16);
  }
}

function openAtlas(run, choose) {
  const canvas = element("atlas"), frames = new Map(), frameS = (run.times[run.times.length - 1] - run.times[0]) / Math.max(run.times.length - 1, 1);
  run.bands = bandsOf(run);
  const rowAt = (event) => {
    const box = canvas.getBoundingClientRect();
    return Math.max(0, Math.min(run.places.length - 1, Math.floor(((event.clientX - box.left) / box.width) * run.places.length)));
  };
  for (const { text, tone, first, last, place } of run.bands) {
    const name = place && !isSegment(run, place) ? "other submaps" : text;
    frames.set(name, { tone, count: last + 1 - first + (frames.get(name)?.count || 0) });
  }
  const longest = [...frames].sort((one, other) => other[1].count - one[1].count);
  element("atlas-key").replaceChildren(...longest.map(([text, { tone, count }]) => {
    const item = document.createElement("span");
    item.style.setProperty("--tone", tone);
    item.textContent = `${text} ${(count * frameS).toFixed(1)} s`;
    return item;
  }));
  const hint = "Bands: what each second is (R: the result). Arcs join parts of one submap: the thicker, the more loops; dashed: found again, without a loop.";
  put("atlas-note", hint);
  put("submaps-title", run.used_part ? `The part of the video that was used: ${run.used_part}` : "The whole video");
  canvas.onclick = (event) => choose(rowAt(event));
  canvas.onpointerleave = () => put("atlas-note", hint);
  canvas.onpointermove = (event) => {
    const at = rowAt(event), band = run.bands.find(({ first, last }) => first <= at && at <= last), part = run.parts.find(({ first, last }) => first <= at && at <= last);
    const joined = band.place === undefined || !part ? [] : part.joined.map((join) => `joined to the part from ${run.times[run.parts[join.part].first].toFixed(1)} s on: ${joinInWords(join)}`);
    put("atlas-note", [`${run.times[band.first].toFixed(1)} to ${run.times[band.last].toFixed(1)} s: ${band.text}`, ...joined].join("; "));
  };
  drawAtlas(canvas, run);
}
