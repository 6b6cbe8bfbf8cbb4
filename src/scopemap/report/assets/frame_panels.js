// The four pictures of a frame: video, depth, the surface seen from there, and how the two depths differ.

const DIFFERENCE_LIMIT = 0.2;
// Of the pixels that the mask leaves out, in pictures of depth.
const MASKED_GREY = 110;

function dimensioned(canvas, width, height) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  return canvas.getContext("2d", { willReadFrequently: true });
}

function blank(canvas, width, height, words) {
  const context = dimensioned(canvas, width, height);
  context.fillStyle = "#20262e";
  context.fillRect(0, 0, width, height);
  context.fillStyle = "#c7d0da";
  context.font = `${Math.round(width / 20)}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.fillText(words, width / 2, height / 2, width * 0.92);
  canvas.setAttribute("aria-label", words);
}

// Return an image's RGBA bytes at a size, nearest pixels.
function bytesOfImage(image, width, height) {
  const canvas = document.createElement("canvas"), context = dimensioned(canvas, width, height);
  context.imageSmoothingEnabled = false;
  context.drawImage(image, 0, 0, width, height);
  return context.getImageData(0, 0, width, height).data;
}

async function imageOf(base64, kind) {
  const image = new Image();
  image.src = `data:image/${kind};base64,${base64}`;
  await image.decode();
  return image;
}

// Blue where the surface is nearer than the frame's depth, white where they agree, red where it is farther.
function differenceColour(share) {
  const s = Math.max(-1, Math.min(1, share / DIFFERENCE_LIMIT)), rest = 1 - Math.abs(s);
  return s < 0 ? [40 + 205 * rest, 90 + 155 * rest, 200 + 45 * rest] : [200 + 45 * rest, 50 + 195 * rest, 40 + 205 * rest];
}

// A bar of a round length, about a quarter of a canvas, which is so many px per mm; where: at which distance.
function drawScaleBar(canvas, pxPerMm, where) {
  const { width, height } = canvas, context = canvas.getContext("2d"), unit = width / 320;
  const mm = roundLength(pxPerMm, 0.25 * width), px = mm * pxPerMm, words = `${short(mm)} mm ${where}`;
  Object.assign(context, { font: `${15 * unit}px system-ui, sans-serif`, textAlign: "left", fillStyle: "#000a" });
  context.fillRect(4 * unit, height - 36 * unit, Math.max(px, context.measureText(words).width) + 10 * unit, 32 * unit);
  context.fillStyle = "#fff";
  context.fillText(words, 9 * unit, height - 18 * unit);
  context.fillRect(9 * unit, height - 11 * unit, px, 3 * unit);
}

class FramePanels {
  constructor(run, view, turbo) {
    Object.assign(this, { run, view, turbo, decoded: new Map() });
    const { width, height } = run.camera, scale = Math.min(1, 320 / Math.max(width, height));
    this.size = [Math.round(width * scale), Math.round(height * scale)];
    const [sx, sy] = [this.size[0] / width, this.size[1] / height], c = run.camera;
    this.lens = { width: this.size[0], height: this.size[1], fx: c.fx * sx, fy: c.fy * sy, cx: (c.cx + 0.5) * sx - 0.5, cy: (c.cy + 0.5) * sy - 0.5 };
  }

  // Return the picture that is nearest in time, or null; one in another submap, or lost, counts as far.
  nearest(row) {
    const { places, pictures, spacing } = this.run;
    const far = (picture) => Math.abs(picture.row - row) + (places[picture.row] === places[row] ? 0 : spacing);
    return pictures.reduce((best, picture) => (best && far(best) <= far(picture) ? best : picture), null);
  }

  async decode(picture) {
    if (!this.decoded.has(picture)) {
      const parts = [imageOf(picture.jpg, "jpeg"), imageOf(picture.mask, "png"), picture.depth ? imageOf(picture.depth, "png") : null];
      const [video, mask, depth] = await Promise.all(parts);
      if (this.decoded.size > 60) this.decoded.clear();
      this.decoded.set(picture, { video, mask, depth });
    }
    return this.decoded.get(picture);
  }

  // Draw all four; images: of `decode`, or null; mesh and pose: null where the camera is lost. Return the median difference.
  draw(images, mesh, pose, { showMask, far }) {
    const [width, height] = this.size, canvas = (id) => document.getElementById(id);
    const mask = images && bytesOfImage(images.mask, width, height);
    Object.assign(this, { medianMm: 0, drawn: [] });
    if (images) this.#video(canvas("video"), images.video, showMask ? mask : null);
    else blank(canvas("video"), width, height, "no picture was kept");
    const codes = images?.depth && this.#codes(bytesOfImage(images.depth, width, height));
    if (codes) this.#depth(canvas("depth"), codes, mask);
    else blank(canvas("depth"), width, height, "no depth was kept");
    if (!pose || !mesh.vertices) {
      const missing = !this.view ? "needs WebGL 2" : pose ? "no surface" : "camera lost";
      blank(canvas("rendered"), width, height, missing);
      blank(canvas("residual"), width, height, missing);
      return null;
    }
    this.#rendered(canvas("rendered"), mesh, pose, far, images && bytesOfImage(images.video, width, height), mask);
    if (codes) return this.#residual(canvas("residual"), mesh, pose, far, codes, mask);
    blank(canvas("residual"), width, height, "no depth was kept");
    return null;
  }

  // A scale bar in each picture, where sizes are known, for what is as far away as the frame's median depth.
  drawScale() {
    const mm = this.run.scale_known && this.medianMm;
    if (mm) this.drawn.forEach((canvas) => drawScaleBar(canvas, this.lens.fx / mm, `at ${short(mm)} mm`));
  }

  // Depth in levels: 1..255 = near..far, logarithmic, 0 = unknown; of pictures whose red and green are its units.
  #codes(bytes) {
    const [near, far] = this.run.depth_range, depths = [];
    for (let i = 0; i < bytes.length; i += 4) {
      const mm = (256 * bytes[i] + bytes[i + 1]) * this.run.depth_unit_mm;
      bytes[i] = mm ? Math.max(1, Math.min(255, Math.round(1 + (254 * Math.log(mm / near)) / Math.log(far / near)))) : 0;
      if (mm) depths.push(mm);
    }
    this.medianMm = Float64Array.from(depths).sort()[depths.length >> 1] || 0;
    return bytes;
  }

  #put(canvas, bytes, label) {
    dimensioned(canvas, ...this.size).putImageData(new ImageData(bytes, ...this.size), 0, 0);
    canvas.setAttribute("aria-label", label);
    this.drawn.push(canvas);
  }

  #video(canvas, image, mask) {
    this.drawn.push(canvas);
    const context = dimensioned(canvas, ...this.size);
    context.drawImage(image, 0, 0, ...this.size);
    canvas.setAttribute("aria-label", "Frame of the video" + (mask ? ", unused parts dimmed" : ""));
    if (!mask) return;
    const shown = context.getImageData(0, 0, ...this.size), data = shown.data, [width] = this.size;
    for (let i = 0; i < data.length; i += 4) {
      if (mask[i] > 127) continue;
      const striped = ((i / 4) % width) + Math.floor(i / 4 / width);
      const lift = striped % 7 < 2 ? 70 : 0;
      data[i] = data[i] * 0.35 + lift;
      data[i + 1] = data[i + 1] * 0.35 + lift;
      data[i + 2] = data[i + 2] * 0.35 + lift + 25;
    }
    context.putImageData(shown, 0, 0);
  }

  #depth(canvas, codes, mask) {
    const bytes = new Uint8ClampedArray(codes.length);
    for (let i = 0; i < codes.length; i += 4) {
      const known = codes[i] > 0 && mask[i] > 127, level = 255 - Math.round(((codes[i] - 1) * 255) / 254);
      for (let k = 0; k < 3; k++) bytes[i + k] = known ? this.turbo[3 * level + k] : mask[i] > 127 ? 32 : MASKED_GREY;
      bytes[i + 3] = 255;
    }
    this.#put(canvas, bytes, "Depth of the frame: red is near, blue is far, grey is no tissue");
  }

  #rendered(canvas, mesh, pose, far, frame, mask) {
    const options = { purpose: 1, lamp: this.run.albedo }, near = far / 4000;
    const light = (bytes) => {
      const sums = [0, 0];
      for (let i = 0; i < bytes.length; i += 16) {
        if (!bytes[i + 3] || (mask && mask[i] <= 127)) continue;
        sums[0] += bytes[i] + bytes[i + 1] + bytes[i + 2];
        sums[1] += frame ? frame[i] + frame[i + 1] + frame[i + 2] : 330;
      }
      return sums[0] ? sums[1] / sums[0] : 1;
    };
    // The lamp's power is not known: once dim enough that nothing is cut off, then as bright as the frame.
    const dim = this.run.albedo ? 0.8 * this.run.depth_range[0] ** (2 / 2.2) : 1;
    const gain = dim * light(this.view.pixels(mesh, pose, this.lens, near, far, { ...options, gain: dim }));
    const bytes = this.view.pixels(mesh, pose, this.lens, near, far, { ...options, gain });
    for (let i = 3; i < bytes.length; i += 4) if (!bytes[i]) bytes.set([58, 66, 76, 255], i - 3);
    this.#put(canvas, bytes, "The surface as the camera of this frame sees it");
  }

  #residual(canvas, mesh, pose, far, codes, mask) {
    const [nearDepth, farDepth] = this.run.depth_range, logs = Math.log(farDepth / nearDepth);
    const bytes = this.view.pixels(mesh, pose, this.lens, far / 4000, far, { purpose: 2, depthRange: [nearDepth, farDepth] });
    const sizes = [];
    for (let i = 0; i < bytes.length; i += 4) {
      const usable = codes[i] > 1 && codes[i] < 255 && mask[i] > 127, covered = bytes[i + 3] > 0;
      let colour = mask[i] <= 127 ? Array(3).fill(MASKED_GREY) : covered || !usable ? [32, 32, 32] : [224, 178, 60];
      if (usable && covered) {
        const level = ((bytes[i] * 256 + bytes[i + 1] - 1) / 65534) * 3 - 1;
        const share = Math.exp((level - (codes[i] - 1) / 254) * logs) - 1;
        sizes.push(Math.abs(share));
        colour = differenceColour(share);
      }
      bytes.set([...colour, 255], i);
    }
    const median = sizes.length ? sizes.sort((a, b) => a - b)[sizes.length >> 1] : null;
    const words = median === null ? "nothing to compare" : `median difference ${(100 * median).toFixed(1)} %`;
    this.#put(canvas, bytes, `Surface against depth: white where they agree, blue where the surface is nearer, red where it is farther, yellow where it is missing, grey is no tissue; ${words}`);
    return median;
  }
}
