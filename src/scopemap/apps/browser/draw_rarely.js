// viser draws the scene once a second, and for a while after each change: without a graphics card that takes a processor
// from the run that is shown. While a run goes on the page draws every three seconds, and at once where someone moves it.
(() => {
  const PAUSE_MS = 3000, FREE_MS = 3000;
  const frame = window.requestAnimationFrame.bind(window), cancel = window.cancelAnimationFrame.bind(window);
  const waiting = new Map();
  let touched = performance.now(), drawn = 0, next = -1;
  const draw = (id) => {
    const { call, timer } = waiting.get(id);
    clearTimeout(timer);
    waiting.delete(id);
    frame((time) => { drawn = performance.now(); call(time); });
  };
  window.requestAnimationFrame = (call) => {
    const now = performance.now();
    if (now - touched < FREE_MS || document.getElementById("ELEMENT") === null) return frame(call);
    const id = next--;
    waiting.set(id, { call, timer: setTimeout(() => draw(id), Math.max(0, drawn + PAUSE_MS - now)) });
    return id;
  };
  window.cancelAnimationFrame = (id) => {
    if (!waiting.has(id)) return cancel(id);
    clearTimeout(waiting.get(id).timer);
    waiting.delete(id);
  };
  const touch = () => {
    touched = performance.now();
    [...waiting.keys()].forEach(draw);
  };
  for (const kind of ["pointermove", "pointerdown", "wheel", "keydown", "resize"]) {
    window.addEventListener(kind, touch, { capture: true, passive: true });
  }
})();
