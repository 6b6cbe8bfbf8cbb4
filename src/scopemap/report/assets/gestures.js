// Mouse, fingers and keys; then the start.

function zoom(factor) {
  turn.distance = Math.max(0.02, Math.min(8, turn.distance * factor));
  redraw();
}

function turnBy(yaw, pitch) {
  turn.yaw += yaw;
  turn.pitch = Math.max(-1.55, Math.min(1.55, turn.pitch + pitch));
  redraw();
}

function moveBy(dx, dy) {
  const from = eye(run.places[row] === shown ? run.poseOf(row) : null), step = (2 * run.balls[shown].radius * turn.distance) / element("scene").clientHeight;
  turn.shift = add(turn.shift, add(scaled(column(from.R, 0), -dx * step), scaled(column(from.R, 1), -dy * step)));
  redraw();
}

function reset() {
  const overview = element("look").value === "overview";
  turn = { yaw: overview ? -0.7 : 0, pitch: overview ? -0.4 : 0, distance: 1, shift: [0, 0, 0] };
  redraw();
}

function listenToScene(scene) {
  const fingers = new Map(), span = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  scene.addEventListener("pointerdown", (event) => (fingers.set(event.pointerId, [event.clientX, event.clientY]), scene.setPointerCapture(event.pointerId)));
  for (const end of ["pointerup", "pointercancel"]) scene.addEventListener(end, (event) => fingers.delete(event.pointerId));
  scene.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]], before = fingers.size === 2 ? span() : 0;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size === 2) (zoom(before / Math.max(span(), 1)), moveBy(dx / 2, dy / 2));
    else if (event.shiftKey || event.buttons === 2) moveBy(dx, dy);
    else turnBy(-dx * 0.007, dy * 0.007);
  });
  // The wheel scrolls the page over a surface that was not clicked since the pointer came.
  let taken = false;
  scene.addEventListener("pointerdown", () => (taken = true));
  scene.addEventListener("pointerleave", () => (taken = false));
  scene.addEventListener("wheel", (event) => (taken || event.ctrlKey) && (event.preventDefault(), zoom(Math.exp(event.deltaY * 0.001))), { passive: false });
  scene.addEventListener("contextmenu", (event) => event.preventDefault());
  const keys = {
    ArrowLeft: () => turnBy(0.1, 0), ArrowRight: () => turnBy(-0.1, 0), ArrowUp: () => turnBy(0, -0.1), ArrowDown: () => turnBy(0, 0.1),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1), 0: reset,
  };
  scene.addEventListener("keydown", (event) => keys[event.key] && (event.preventDefault(), keys[event.key]()));
}

function start() {
  try {
    view = new SurfaceView(element("scene"), ramp, () => setRow(row));
  } catch (fault) {
    element("no-gl").hidden = false;
  }
  const choice = element("run");
  data.runs.forEach((one, number) => choice.append(new Option(`${one.name}: ${one.verdict.word}`, number)));
  element("choose-run").hidden = data.runs.length < 2;
  choice.addEventListener("change", () => open(Number(choice.value)));
  element("slider").addEventListener("input", (event) => setRow(Number(event.target.value)));
  element("slider").addEventListener("keydown", (event) => {
    const steps = { ArrowUp: 1, ArrowDown: -1, PageUp: 10, PageDown: -10 };
    if (event.key in steps) (event.preventDefault(), setRow(row + steps[event.key]));
  });
  element("play").addEventListener("click", play);
  element("theme").addEventListener("click", () => setTheme(root.dataset.theme !== "dark"));
  element("look").addEventListener("change", reset);
  element("paint").addEventListener("change", () => (writeLegend(), redraw()));
  element("cut").addEventListener("change", redraw);
  element("mask").addEventListener("change", () => setRow(row));
  listenToScene(element("scene"));
  listenToPlaces();
  new ResizeObserver(() => run && (drawStrip(element("strip"), run), curves.forEach((curve) => curve.draw(row)), redraw())).observe(document.body);
  const wish = matchMedia("(prefers-color-scheme: dark)");
  setTheme(wish.matches);
  wish.addEventListener("change", () => setTheme(wish.matches));
  open(0);
}
start();
