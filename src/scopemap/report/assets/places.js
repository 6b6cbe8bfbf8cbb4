// A place on the surface: the nearest frame that saw it, and where pictures of frames show it.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const norm = (a) => Math.sqrt(dot(a, a));
const unprojected = (c, [x, y]) => [(x - c.cx) / c.fx, (y - c.cy) / c.fy, 1];
const inCamera = ({ R, t }, p) => rotated(transposed(R), minus(p, t));
// Share of its depth by which the surface may be nearer than a place that a frame sees all the same.
const SAME_PLACE = 0.02;

// Positions (3 numbers a vertex) and faces of a map's surface.
function surfaceOf(map) {
  if (map.surface) return map.surface;
  const levels = new Uint16Array(bytesOf(map.positions));
  const p = Float64Array.from(levels, (level, i) => map.low[i % 3] + (level / 65535) * map.spread[i % 3]);
  return (map.surface = { faces: new Uint32Array(bytesOf(map.faces)), at: (v) => [p[3 * v], p[3 * v + 1], p[3 * v + 2]] });
}

// The first point of a surface on a ray, or null; frontOnly: seen from behind it is looked through.
function meet({ faces, at }, origin, ray, frontOnly = false) {
  let best = Infinity;
  for (let f = 0; f < faces.length; f += 3) {
    const corner = at(faces[f]), first = minus(at(faces[f + 1]), corner), second = minus(at(faces[f + 2]), corner);
    const across = cross(ray, second), determinant = dot(first, across), shift = minus(origin, corner), u = dot(shift, across) / determinant;
    if (!(u >= -1e-9 && u <= 1 + 1e-9) || (frontOnly && determinant < 0)) continue;
    const along = cross(shift, first), v = dot(along, ray) / determinant, distance = dot(second, along) / determinant;
    if (v >= -1e-9 && u + v <= 1 + 1e-9 && distance > 1e-9 && distance < best) best = distance;
  }
  return best < Infinity ? add(origin, scaled(ray, best)) : null;
}

// The pixel of a point in a picture's frame, and its depth there; null beside the picture, and behind the camera.
function pixelIn(picture, point) {
  const [x, y, z] = inCamera(run.poseOf(picture.row), point), c = run.camera, pixel = [(x / z) * c.fx + c.cx, (y / z) * c.fy + c.cy];
  const inside = z > 0 && pixel.every((value, k) => value >= -0.5 && value < [c.width, c.height][k] - 0.5);
  return inside ? { pixel, depth: z } : null;
}

// The picture of the nearest frame of the shown map that saw a point, nothing before it; null: none did.
function nearestSight(point) {
  const seen = run.pictures.filter(({ row }) => run.places[row] === shown).map((picture) => ({ picture, ...pixelIn(picture, point) }));
  const isFree = ({ picture, depth }) => {
    const { t } = run.poseOf(picture.row), met = meet(surfaceOf(run.maps[shown]), t, minus(point, t));
    return met && norm(minus(met, point)) < SAME_PLACE * depth;
  };
  return seen.filter(({ depth }) => depth).sort((a, b) => a.depth - b.depth).find(isFree)?.picture || null;
}

// Mark a point of a map, or nothing.
function mark(at, map = shown) {
  run.marked = at && { at, map };
  put("place-note", at ? "" : "There is no surface here.");
}

function clickOnSurface(event) {
  const box = element("scene").getBoundingClientRect(), from = eye(run.places[row] === shown ? run.poseOf(row) : null);
  const ray = unprojected(lensOf(box.width, box.height, from.fieldOfView), [event.clientX - box.left - 0.5, event.clientY - box.top - 0.5]);
  const at = meet(surfaceOf(run.maps[shown]), from.t, rotated(from.R, ray), element("cut").checked), sight = at && nearestSight(at);
  mark(at);
  if (at) put("place-note", sight ? `The nearest frame that saw this place is ${run.indices[sight.row]}.` : "No frame with a picture saw this place.");
  setRow(sight ? sight.row : row);
}

function clickOnPicture(event) {
  const canvas = event.currentTarget, box = canvas.getBoundingClientRect(), picture = panels.shown;
  if (!picture || run.places[picture.row] !== shown) return put("place-note", "This frame has no pose: where it looks is unknown.");
  const share = Math.min(box.width / canvas.width, box.height / canvas.height), c = run.camera; // object-fit: contain
  const at = (client, start, size, pixels, all) => ((client - start - (size - pixels * share) / 2) / share) * (all / pixels) - 0.5;
  const pixel = [at(event.clientX, box.left, box.width, canvas.width, c.width), at(event.clientY, box.top, box.height, canvas.height, c.height)];
  if (!pixel.every((value, k) => value >= -0.5 && value < [c.width, c.height][k] - 0.5)) return null;
  const pose = run.poseOf(picture.row);
  mark(meet(surfaceOf(run.maps[shown]), pose.t, rotated(pose.R, unprojected(c, pixel))));
  return setRow(row);
}

// A cross at a point, as lines of the scene.
const crossAt = (at, size, ink) => [[1, 1, 0], [1, -1, 0], [0, 1, 1]].map((way) => ({ from: add(at, scaled(way, size)), to: add(at, scaled(way, -size)), colour: ink }));

// The marked place, a cross in front of the surface.
const markedLines = () => (run.marked?.map === shown ? crossAt(run.marked.at, 0.05 * run.balls[shown].radius, colour("--hand")) : []);

// Shapes of pixels in the pictures of the frame: crosses, joined by lines.
function drawShapes(shapes) {
  const c = run.camera, place = ([x, y]) => [((x + 0.5) * panels.size[0]) / c.width, ((y + 0.5) * panels.size[1]) / c.height];
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

// The marked place and what was measured, in the pictures of the frame that is shown.
function markPictures() {
  const picture = panels.shown;
  if (!picture || run.places[picture.row] !== shown) return;
  const marked = run.marked?.map === shown && pixelIn(picture, run.marked.at);
  drawShapes([...measuredShapes(picture), ...(marked ? [[marked.pixel]] : [])]);
}

function listenToPlaces() {
  for (const id of ["video", "depth", "rendered", "residual"]) element(id).addEventListener("click", clickOnPicture);
  let down = null;
  element("scene").addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
  element("scene").addEventListener("click", (event) => down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4 && clickOnSurface(event));
}
