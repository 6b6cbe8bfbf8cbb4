// The page's texts: verdict, facts, settings. Everything from a run goes in as text, never as HTML.

const ICONS = { good: "✓", doubtful: "!", bad: "✕" };
const put = (id, text) => (document.getElementById(id).textContent = text);

function list(id, items) {
  const box = document.getElementById(id);
  box.replaceChildren(...items.map(([text, kind]) => {
    const item = document.createElement("li");
    item.textContent = text;
    if (kind) item.className = kind;
    return item;
  }));
}

function writeVerdict(run) {
  const { level, word, advice, reasons } = run.verdict, names = { bad: "Against it: ", doubtful: "Caution: ", note: "Note: ", good: "For it: " };
  document.getElementById("verdict").dataset.level = level;
  document.querySelector(".word .icon").textContent = ICONS[level];
  put("word", word[0].toUpperCase() + word.slice(1));
  put("advice", advice);
  list("reasons", reasons.map((reason) => [reason.text, reason.level]));
  document.querySelectorAll("#reasons li").forEach((item) => item.setAttribute("aria-label", names[item.className] + item.textContent));
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
    ["Depth by", estimators.depth], ["Scale", run.scale_known ? (facts.scale.stated ? "as stated: " : "") + run.scale_source : `unknown: ${run.scale_source}`], ["Flow by", estimators.flow],
    ["Surface", `${mesh.all_faces.toLocaleString("en")} triangles (here ${(bytesOf(mesh.faces).byteLength / 12).toLocaleString("en")})`],
    ["Time", seconds ? `${seconds.toFixed(0)} s${run.frames_per_s ? `, ${run.frames_per_s.toFixed(1)} frames/s` : ""}` : null],
    ["Machine", facts.machine],
    ["True path", run.truth ? `known; RMS distance ${(100 * run.truth.error_share).toFixed(1)} % of the path's length, after alignment with scale` : null],
  ];
  document.getElementById("facts").replaceChildren(...rows.filter(([, value]) => value).map(([name, value]) => {
    const row = document.createElement("div"), label = document.createElement("b"), text = document.createElement("span");
    label.textContent = name;
    text.textContent = value;
    row.append(label, text);
    return row;
  }));
  list("notes", run.notes.map((text) => [text]));
  put("settings", run.config || "not kept");
  const named = (pairs) => Object.entries(pairs || {}).map(([key, value]) => `${key}: ${value}`).join(" · ");
  document.getElementById("versions").replaceChildren(
    paragraph(`Versions: ${named(facts.versions)}`),
    paragraph(`Networks and weights: ${named(estimators)}`),
    paragraph(run.licences),
  );
}

function statusOf(run, row) {
  const place = run.places[row], reason = run.reasons[run.reasonOf[row]];
  if (place === 0) return "in the result";
  if (place > 0) return `in submap ${place} (maps/${place}), not in the result`;
  if (place === OTHER_MAP) return "followed, but in a submap too short to be kept";
  if (place === ROTATED) return `camera lost but for its rotation: ${reason || "no reason was kept"}`;
  return place === NOT_USED ? `not used: ${reason || "left out"}` : `camera lost: ${reason || "no reason was kept"}`;
}

function legendOf(run, map, paint) {
  if (paint === 1) return ["never", `in all of ${map.looked} frames looked at`];
  if (paint === 4) return ["never moves on its own", "in all frames that see it"];
  return paint === 2 ? ["little", "much: seen often, near, from the front"] : null;
}
