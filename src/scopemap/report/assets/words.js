// The page's texts: verdict, facts, settings. Everything from a run goes in as text, never as HTML.

const ICONS = { good: "✓", doubtful: "!", bad: "✕" };
const put = (id, text) => (document.getElementById(id).textContent = text);

function list(id, items) {
  const box = document.getElementById(id);
  box.replaceChildren(...items.map(([text, kind, below]) => {
    const item = document.createElement("li");
    item.textContent = text;
    if (kind) item.className = kind;
    if (below) item.append(Object.assign(document.createElement("small"), { textContent: below }));
    return item;
  }));
}

function writeVerdict(run) {
  const { level, word, advice, reasons } = run.verdict, names = { bad: "Against it: ", doubtful: "Caution: ", note: "Note: ", good: "For it: " };
  document.getElementById("verdict").dataset.level = level;
  document.querySelector(".word .icon").textContent = ICONS[level];
  put("word", word[0].toUpperCase() + word.slice(1));
  put("advice", advice);
  list("reasons", reasons.map((reason) => {
    const exact = reason.next_step === reason.plain_step ? "" : `Files and options: ${reason.next_step}`;
    return [`${reason.text} ${reason.plain_step}`.trim(), reason.level, exact];
  }));
  document.querySelectorAll("#reasons li").forEach((item) => item.setAttribute("aria-label", names[item.className] + item.innerText));
}

function paragraph(text) {
  const made = document.createElement("p");
  made.textContent = text;
  return made;
}

function writeDetails(run) {
  const facts = run.provenance, estimators = facts.estimators || {}, mesh = run.maps[0], seconds = (facts.seconds || {}).total;
  const rows = [
    ["Input", run.input], ["Kind of input", facts.dataset], ["Camera", (facts.camera || {}).source],
    ["Picture", `${run.camera.width} × ${run.camera.height} px, focal length ${run.camera.fx.toFixed(1)} px`],
    ["Depth", estimators.depth], ["Scale", run.scale_known ? (facts.scale.stated ? "as stated: " : "") + run.scale_source : `unknown (${run.scale_source})`], ["Optical flow", estimators.flow],
    ["Surface", `${mesh.all_faces.toLocaleString("en")} triangles (here ${(bytesOf(mesh.faces).byteLength / 12).toLocaleString("en")})`],
    ["Time", seconds ? `${seconds.toFixed(0)} s${run.frames_per_s ? `, ${run.frames_per_s.toFixed(1)} frames/s` : ""}` : null],
    ["Machine", facts.machine],
    ["True path", run.truth ? `known; RMS error ${(100 * run.truth.error_share).toFixed(1)} % of the path length, after alignment with scale` : null],
  ];
  document.getElementById("facts").replaceChildren(...rows.filter(([, value]) => value).map(([name, value]) => {
    const row = document.createElement("div"), label = document.createElement("b"), text = document.createElement("span");
    label.textContent = name;
    text.textContent = value;
    row.append(label, text);
    return row;
  }));
  list("notes", run.notes.map((text) => [text]));
  put("settings", run.config || "not saved");
  const named = (pairs) => Object.entries(pairs || {}).map(([key, value]) => `${key}: ${value}`).join(" · ");
  document.getElementById("versions").replaceChildren(
    paragraph(`Versions: ${named(facts.versions)}`),
    paragraph(`Networks and weights: ${named(estimators)}`),
    paragraph(run.licences),
  );
}

function statusOf(run, row) {
  const place = run.places[row], reason = run.reasons[run.reasonOf[row]];
  if (place >= 0) return `in ${run.titles[place].name.replace(/^./, (first) => first.toLowerCase())}`;
  if (place === OTHER_MAP) return "tracked, but in a submap too short to be saved";
  if (place === ROTATED) return `camera lost, rotation known: ${reason || "reason unknown"}`;
  return place === NOT_USED ? `not used: ${reason || "left out"}` : `camera lost: ${reason || "reason unknown"}`;
}

// Numbers below a bar of colours: [[place 0..1, text], ...], and what they mean.
function legendOf(run, map, paint) {
  const percent = (share) => `${Math.round(100 * share)} %`;
  if (paint === 1) return [[0, 0.25, 1].map((share) => [Math.sqrt(share), percent(share)]), `of ${map.looked} sampled frames see it`];
  if (paint === 4) return [[0, 0.5, 1].map((share) => [share, percent(share)]), "of the frames that see it show it moving on its own"];
  return paint === 2 ? [[0, 0.5, 1].map((share) => [share, String(share)]), "confidence: high where tissue was seen often, near and from the front"] : null;
}

// A bar of colours, "rgb(...)" from left to right, with numbers at their places.
function colourBar(stops, numbers) {
  const bar = document.createElement("span");
  bar.className = "ramp";
  bar.style.background = `linear-gradient(to right, ${stops.join(", ")})`;
  bar.append(...numbers.map(([place, text]) => {
    const number = document.createElement("i");
    number.textContent = text;
    number.style.left = `${100 * place}%`;
    return number;
  }));
  return bar;
}

// A round length, mm, that is about so many px long.
function roundLength(pxPerMm, wantedPx) {
  const power = 10 ** Math.floor(Math.log10(wantedPx / pxPerMm));
  return power * [5, 2, 1].find((digit) => digit * power * pxPerMm <= wantedPx);
}
