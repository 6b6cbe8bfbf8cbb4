// Distances and areas as `scopemap measure` gives them (apps/measure/measure.py, apps/measure/intervals.py,
// geometry/surface_measures.py, report/measured_surface.py), step by step in the same order: the same triangles, depths, errors.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const norm = (a) => Math.sqrt(dot(a, a));
const unprojected = (c, [x, y]) => [(x - c.cx) / c.fx, (y - c.cy) / c.fy, 1];
const inCamera = ({ R, t }, p) => rotated(transposed(R), minus(p, t));

// Positions (3 numbers a vertex) and faces of a map's measured surface.
function surfaceOf(map) {
  if (map.surface) return map.surface;
  const { positions, low, spread, faces } = map.measured || map, levels = new Uint16Array(bytesOf(positions));
  const p = Float64Array.from(levels, (level, i) => low[i % 3] + (level / 65535) * spread[i % 3]);
  return (map.surface = { p, faces: new Uint32Array(bytesOf(faces)), at: (v) => [p[3 * v], p[3 * v + 1], p[3 * v + 2]] });
}

// The first point of a surface on a ray, {at, face}, or null; frontOnly: seen from behind it is looked through.
function meet({ faces, at }, origin, ray, frontOnly = false) {
  let best = Infinity, face = -1;
  for (let f = 0; f < faces.length / 3; f++) {
    const corner = at(faces[3 * f]), first = minus(at(faces[3 * f + 1]), corner), second = minus(at(faces[3 * f + 2]), corner);
    const across = cross(ray, second), determinant = dot(first, across), shift = minus(origin, corner), u = dot(shift, across) / determinant;
    if (!(u >= -1e-9 && u <= 1 + 1e-9) || (frontOnly && determinant < 0)) continue;
    const along = cross(shift, first), v = dot(along, ray) / determinant, distance = dot(second, along) / determinant;
    if (v >= -1e-9 && u + v <= 1 + 1e-9 && distance > 0 && distance < best) [best, face] = [distance, f];
  }
  return face < 0 ? null : { at: add(origin, scaled(ray, best)), face };
}

// The length of the shortest path on a surface between two of its points; passes: points on an edge, how much longer.
function pathLength(surface, ends) {
  if (ends[0].face === ends[1].face) return norm(minus(ends[1].at, ends[0].at));
  let kept = Uint32Array.from({ length: surface.faces.length / 3 }, (_, f) => f), length = Infinity;
  for (const [onEdge, longer] of [[0, 1.03], [1, 1.01], [3, 1.003], [7, 1]]) {
    const found = shortest(surface, kept, ends, onEdge);
    length = found.length;
    if (!Number.isFinite(length)) break;
    kept = kept.filter((f, k) => {
      const [a, b, c] = [0, 1, 2].map((n) => surface.at(surface.faces[3 * f + n]));
      return found.through[k] <= longer * length + Math.max(norm(minus(a, c)), norm(minus(b, a)), norm(minus(c, b)));
    });
  }
  return length;
}

function joinedPairs(onEdge) {
  const sides = [[0, 1], [1, 2], [2, 0]].map(([a, b], n) => [a, ...Array.from({ length: onEdge }, (_, k) => 3 + n * onEdge + k), b]), pairs = [];
  for (let a = 0; a < 3 + 3 * onEdge; a++) for (let b = a + 1; b < 3 + 3 * onEdge; b++) if (!sides.some((side) => side.includes(a) && side.includes(b))) pairs.push([a, b]);
  for (const side of sides) for (let k = 1; k < side.length; k++) pairs.push([side[k - 1], side[k]]);
  return pairs;
}

// The shortest length through vertices and points on edges, and the shortest through each kept face.
function shortest({ faces, at, p }, kept, ends, onEdge) {
  const count = p.length / 3, edges = new Map(), places = [], each = 3 + 3 * onEdge, nodes = new Uint32Array(each * kept.length);
  const placeOf = (n) => (n < count ? at(n) : places[n - count]);
  kept.forEach((f, k) => [0, 1, 2].forEach((n) => {
    const [v, w] = [faces[3 * f + n], faces[3 * f + ((n + 1) % 3)]], [a, b] = v < w ? [v, w] : [w, v], key = a * count + b;
    nodes[each * k + n] = v;
    if (!edges.has(key)) {
      edges.set(key, count + places.length);
      for (let i = 1; i <= onEdge; i++) places.push(add(at(a), scaled(minus(at(b), at(a)), i / (onEdge + 1))));
    }
    for (let i = 0; i < onEdge; i++) nodes[each * k + 3 + n * onEdge + i] = edges.get(key) + (v < w ? i : onEdge - 1 - i);
  }));
  const from = [], to = [], total = count + places.length, pairs = joinedPairs(onEdge);
  kept.forEach((f, k) => pairs.forEach(([a, b]) => (from.push(nodes[each * k + a]), to.push(nodes[each * k + b]))));
  ends.forEach((end, n) => kept.forEach((f, k) => f === end.face && nodes.subarray(each * k, each * k + each).forEach((node) => (from.push(node), to.push(total + n)))));
  places.push(...ends.map((end) => end.at));
  const starts = new Uint32Array(total + 3);
  for (const list of [from, to]) for (const node of list) starts[node + 1]++;
  for (let n = 0; n < total + 2; n++) starts[n + 1] += starts[n];
  const fill = starts.slice(), beside = new Uint32Array(2 * from.length), lengths = new Float64Array(2 * from.length);
  from.forEach((a, k) => {
    const b = to[k], length = norm(minus(placeOf(b), placeOf(a)));
    for (const [one, other] of [[a, b], [b, a]]) [beside[fill[one]], lengths[fill[one]++]] = [other, length];
  });
  const graph = { starts, beside, lengths }, fromStart = dijkstra(graph, total), fromEnd = dijkstra(graph, total + 1);
  const through = Float64Array.from(kept, (_, k) => nodes.subarray(each * k, each * k + each).reduce((least, node) => Math.min(least, fromStart[node] + fromEnd[node]), Infinity));
  return { length: fromStart[total + 1], through };
}

function dijkstra({ starts, beside, lengths }, first) {
  const found = new Float64Array(starts.length - 1).fill(Infinity), heap = [[0, first]]; // a binary heap of [length, node]
  found[first] = 0;
  while (heap.length) {
    const [length, node] = heap[0], last = heap.pop();
    if (heap.length) {
      let k = 0;
      for (let child; (child = 2 * k + 1) < heap.length; k = child) {
        if (child + 1 < heap.length && heap[child + 1][0] < heap[child][0]) child++;
        if (heap[child][0] >= last[0]) break;
        heap[k] = heap[child];
      }
      heap[k] = last;
    }
    if (length > found[node]) continue;
    for (let e = starts[node]; e < starts[node + 1]; e++) {
      const longer = length + lengths[e];
      if (!(longer < found[beside[e]])) continue;
      found[beside[e]] = longer;
      let k = heap.push(null) - 1;
      for (; k && heap[(k - 1) >> 1][0] > longer; k = (k - 1) >> 1) heap[k] = heap[(k - 1) >> 1];
      heap[k] = [longer, beside[e]];
    }
  }
  return found;
}

// The area of what a camera sees inside a polygon: rendered finely, each cell where the surface does not break off.
function areaInside(surface, polygon, camera, pose) {
  const [low, high] = [Math.min, Math.max].map((least) => [0, 1].map((k) => least(...polygon.map((p) => p[k]))));
  const scale = 400 / Math.max(high[0] - low[0], high[1] - low[1], 1e-6), [width, height] = [0, 1].map((k) => Math.ceil((high[k] - low[k]) * scale) + 2);
  const shift = [(low[0] - camera.cx) * scale - 0.5, (low[1] - camera.cy) * scale - 0.5];
  const part = { fx: camera.fx * scale, fy: camera.fy * scale, cx: -shift[0], cy: -shift[1], width, height }, depth = rendered(surface, part, pose);
  const outline = polygon.map((p) => [(p[0] - low[0]) * scale, (p[1] - low[1]) * scale]);
  const point = (x, y) => scaled(unprojected(part, [x, y]).map(Math.fround), depth[y * width + x]);
  let sum = 0;
  for (let y = 0; y < height - 1; y++) for (let x = 0; x < width - 1; x++) {
    const around = [depth[y * width + x], depth[(y + 1) * width + x + 1], depth[(y + 1) * width + x], depth[y * width + x + 1]];
    if (!(Math.max(...around) < 1.05 * Math.min(...around))) continue;
    const crossed = outline.filter((a, n) => {
      const b = outline[(n + 1) % outline.length];
      return a[1] > y !== b[1] > y && x < (b[0] - a[0]) * ((y - a[1]) / (b[1] - a[1])) + a[0];
    });
    if (crossed.length % 2) sum += norm(cross(minus(point(x + 1, y + 1), point(x, y)), minus(point(x, y + 1), point(x + 1, y)))) / 2;
  }
  return sum;
}

// The depth of a surface in a camera, float32, NaN where nothing is (geometry/rendering.py, `render_mesh`).
function rendered({ p, faces, at }, { fx, fy, cx, cy, width, height }, pose) {
  const inverse = new Float32Array(width * height), corners = new Float64Array(p.length);
  for (let v = 0; v < p.length / 3; v++) {
    const [x, y, z] = inCamera(pose, at(v));
    corners.set(z > 1e-3 ? [(x / z) * fx + cx, (y / z) * fy + cy, 1 / z] : [x * fx + cx, y * fy + cy, -1], 3 * v);
  }
  for (let f = 0; f < faces.length; f += 3) {
    const [ua, va, wa, ub, vb, wb, uc, vc, wc] = [0, 1, 2].flatMap((n) => [...corners.subarray(3 * faces[f + n], 3 * faces[f + n] + 3)]);
    const area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua);
    if (wa < 0 || wb < 0 || wc < 0 || area === 0) continue;
    const lastRow = Math.min(height - 1, Math.floor(Math.max(va, vb, vc))), lastColumn = Math.min(width - 1, Math.floor(Math.max(ua, ub, uc)));
    for (let y = Math.max(0, Math.ceil(Math.min(va, vb, vc))); y <= lastRow; y++) for (let x = Math.max(0, Math.ceil(Math.min(ua, ub, uc))); x <= lastColumn; x++) {
      const inA = ((ub - x) * (vc - y) - (vb - y) * (uc - x)) / area, inB = ((uc - x) * (va - y) - (vc - y) * (ua - x)) / area, inC = 1 - inA - inB;
      const w = inA * wa + inB * wb + inC * wc;
      if (inA >= -1e-9 && inB >= -1e-9 && inC >= -1e-9 && w > inverse[y * width + x]) inverse[y * width + x] = w;
    }
  }
  return inverse.map((w) => (w > 0 ? 1 / w : NaN));
}

const straight = (points) => norm(minus(points[1], points[0]));
const flatArea = (points) => 0.5 * norm(points.slice(2).reduce((sum, _, k) => add(sum, cross(minus(points[k + 1], points[0]), minus(points[k + 2], points[0]))), [0, 0, 0]));

// Changes of ln of a figure of picked points as each source of error stands at the ends of its 95 % interval.
const SIGMAS = 1.96, ENDS = [-SIGMAS, SIGMAS];
function changesOf(camera, picked, errors, figure) {
  const exact = Math.max(figure(picked.map(({ pixel, depth }) => scaled(unprojected(camera, pixel), depth))), 1e-9);
  const moved = (by) => ENDS.map((end) => Math.log(Math.max(figure(picked.map(({ pixel, depth, error }, n) => {
    const own = by.point === n ? by : {}, half = (error / Math.SQRT2) * end, lens = 1 + (by.focal ? errors.focal * end : 0);
    const ray = unprojected(camera, [pixel[0] + (own.x ? errors.pixel_px * end : 0), pixel[1] + (own.y ? errors.pixel_px * end : 0)]);
    return scaled([ray[0] / lens, ray[1] / lens, 1], depth * Math.exp(by.depth || own.ownDepth ? half : 0));
  })), 1e-9) / exact));
  const own = picked.flatMap((_, point) => [{ ownDepth: true }, { x: true }, { y: true }].map((which) => moved({ ...which, point })));
  return { shared: [moved({ depth: true }), moved({ focal: true }), [0, 0]], own };
}

const toPower = ({ shared, own }, power) => ({ shared: shared.map((ends) => ends.map((x) => power * x)), own: own.map((ends) => ends.map((x) => power * x)) });
const combined = (a, b) => ({ shared: a.shared.map((ends, k) => ends.map((x, n) => x + b.shared[k][n])), own: [...a.own, ...b.own] });

// The ends of a figure's 95 % interval over its value.
function factorsOf({ shared, own }) {
  const all = [...shared, ...own];
  const lower = Math.hypot(...all.map((ends) => Math.min(0, ...ends))), higher = Math.hypot(...all.map((ends) => Math.max(0, ...ends)));
  return [Math.exp(-lower), Math.exp(higher)];
}

// Refuse a reference whose two pixels are so near that errors of picking them would decide.
function checkReference([[a, b], [c, d]], errors) {
  const px = Math.hypot(c - a, d - b);
  if (px < errors.reference_px) throw new Error(`the reference is ${px.toFixed(1)} px long: ${errors.reference_px} px are needed`);
}

// What was measured in a frame {camera, pose, map, name, depthAt}: [{what, value, low, high, unit}]; refusals are thrown.
function measured(frame, pixels, reference = null, referenceMm = null) {
  const { camera, pose, map } = frame, surface = surfaceOf(map), errors = map.errors;
  const picked = (places) => places.map((pixel) => {
    const inside = pixel[0] >= -0.5 && pixel[1] >= -0.5 && pixel[0] < camera.width - 0.5 && pixel[1] < camera.height - 0.5;
    const found = inside && meet(surface, pose.t, rotated(pose.R, unprojected(camera, pixel)));
    if (!found) throw new Error(`no surface at pixel ${pixel} of frame ${frame.name}`);
    const depth = dot(minus(found.at, pose.t), column(pose.R, 2)), [own, sigma] = frame.depthAt(pixel);
    const known = [Math.abs(own - depth) / depth, sigma / depth].filter(Number.isFinite);
    return { ...found, pixel, depth, error: known.length ? Math.max(...known) : errors.depth };
  });
  const points = picked(pixels);
  let unit = "mm", divisor = 1, ofScale = { shared: [[0, 0], [0, 0], ENDS.map((end) => errors.scale * end)], own: [] };
  if (reference) {
    checkReference(reference, errors);
    const known = picked(reference);
    divisor = straight(known.map((point) => point.at));
    ofScale = toPower(changesOf(camera, known, errors, straight), -1);
    if (!referenceMm) unit = "times the reference";
    divisor /= referenceMm || 1;
  }
  const given = (what, value, changes) => {
    const [low, high] = factorsOf(changes);
    return { what, value, low: value * low, high: value * high, unit };
  };
  if (pixels.length > 2) {
    const area = areaInside(surface, pixels, camera, pose);
    if (area <= 0) throw new Error(`no surface is seen inside the polygon of frame ${frame.name}`);
    unit = unit === "mm" ? "mm2" : "times the reference's square";
    return [given("area", area / divisor ** 2, combined(changesOf(camera, points, errors, flatArea), toPower(ofScale, 2)))];
  }
  const changes = combined(changesOf(camera, points, errors, straight), ofScale);
  return [given("straight", straight(points.map((point) => point.at)) / divisor, changes), given("along the surface", pathLength(surface, points) / divisor, changes)];
}
