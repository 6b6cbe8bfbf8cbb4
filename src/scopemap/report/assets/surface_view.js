// The meshes of a run in WebGL 2: on the screen with path and camera, and into pictures for the panels.

const MESH_VERTEX = `#version 300 es
in vec3 position; in vec3 normal; in vec3 colour; in vec3 scalars; in vec2 place;
uniform vec3 low, spread; uniform mat4 view, lens;
out vec3 vEye, vNormal, vColour; out vec3 vScalars; out vec2 vPlace;
void main() {
  vec4 eye = view * vec4(low + position * spread, 1.0);
  vEye = eye.xyz; vNormal = mat3(view) * normal; vColour = colour; vScalars = scalars; vPlace = place;
  gl_Position = lens * eye;
}`;

// ${data.pale.sure.toFixed(4)}, PALE and LEAST_COLOUR are those of report/pale_parts.py.
// pale: confidence from which on colours are full, level of the grey, share of colour that is left; 0: nothing is pale.
// purpose 0: for the screen; 1: as the lamp at the lens shows it; 2: log depth in 16 bits.
const MESH_FRAGMENT = `#version 300 es
precision highp float;
in vec3 vEye, vNormal, vColour; in vec3 vScalars; in vec2 vPlace;
uniform int purpose, paint; uniform bool cut, lamp, textured; uniform vec3 pale; uniform float gain; uniform vec2 depthRange;
uniform sampler2D ramp, tissue;
out vec4 result;
void main() {
  vec3 ray = normalize(-vEye);
  if (cut && !gl_FrontFacing) discard;
  if (purpose == 2) {
    float level = clamp(log(-vEye.z / depthRange.x) / log(depthRange.y / depthRange.x), -1.0, 2.0);
    float code = floor((level + 1.0) / 3.0 * 65534.0 + 0.5) + 1.0;
    result = vec4(floor(code / 256.0) / 255.0, mod(code, 256.0) / 255.0, 0.0, 1.0);
    return;
  }
  float facing = abs(dot(normalize(vNormal), ray));
  vec3 base = textured ? texture(tissue, vPlace).rgb : vColour;
  if (purpose == 0) base = min(gain * base, 1.0);
  if (paint == 1) base = texture(ramp, vec2(sqrt(vScalars.y), 0.5)).rgb;
  if (paint == 2) base = texture(ramp, vec2(vScalars.x, 0.5)).rgb;
  if (paint == 4) base = texture(ramp, vec2(vScalars.z, 0.5)).rgb;
  if (paint == 3) base = vec3(0.74, 0.72, 0.70);
  if (paint == 0 && pale.x > 0.0) {
    float sure = clamp(vScalars.x * (1.0 - vScalars.z) / pale.x, 0.0, 1.0);
    base = mix(vec3(pale.y), base, mix(pale.z, 1.0, sure));
  }
  if (purpose == 1) {
    float light = lamp ? pow(max(facing, 0.02) / dot(vEye, vEye), 1.0 / 2.2) : 1.0;
    result = vec4(min(gain * light * base, 1.0), 1.0);
  } else {
    result = vec4(base * (0.32 + 0.68 * facing), 1.0);
  }
}`;

const LINE_VERTEX = `#version 300 es
in vec3 from, to; in vec4 colour; in float dashes;
uniform mat4 view, lens; uniform vec2 size; uniform float width, near;
out vec4 vColour; out float vAlong;
void main() {
  vec4 a = view * vec4(from, 1.0), b = view * vec4(to, 1.0);
  if (a.z > -near && b.z < -near) a = mix(a, b, (-near - a.z) / (b.z - a.z));
  if (b.z > -near && a.z < -near) b = mix(b, a, (-near - b.z) / (a.z - b.z));
  vec4 p = lens * a, q = lens * b;
  vec2 along = (q.xy / q.w - p.xy / p.w) * size;
  vec2 across = length(along) > 1e-6 ? normalize(vec2(-along.y, along.x)) : vec2(0.0, 1.0);
  float side = float(gl_VertexID & 1) * 2.0 - 1.0; bool end = gl_VertexID > 1;
  vec4 here = end ? q : p;
  here.xy += across * side * width / size * here.w;
  here.z -= 0.0005 * here.w;
  vColour = colour; vAlong = dashes * (end ? length(along) : 0.0) / 12.0;
  gl_Position = (a.z > -near && b.z > -near) ? vec4(2.0, 2.0, 2.0, 1.0) : here;
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec4 vColour; in float vAlong; uniform float alpha; out vec4 result;
void main() { if (fract(vAlong) > 0.55) discard; result = vec4(vColour.rgb, vColour.a * alpha); }`;

const PICTURE_VERTEX = `#version 300 es
in vec3 position; in vec2 place; uniform mat4 view, lens; out vec2 vPlace;
void main() { vPlace = place; gl_Position = lens * view * vec4(position, 1.0); }`;

const PICTURE_FRAGMENT = `#version 300 es
precision highp float;
in vec2 vPlace; uniform sampler2D picture; out vec4 result;
void main() { result = vec4(texture(picture, vPlace).rgb, 0.92); }`;

// The rows of an array, each of so many values, that are asked for.
function rowsOf(values, count, rows) {
  const found = new values.constructor(count * rows.length);
  for (let i = 0; i < rows.length; i++) for (let k = 0; k < count; k++) found[count * i + k] = values[count * rows[i] + k];
  return found;
}

class SurfaceView {
  // canvas: on the page. ramp: 768 bytes, the colours of 256 levels. changed: called when a mesh looks different.
  constructor(canvas, ramp, changed) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("WebGL 2 is missing");
    Object.assign(this, { canvas, gl, changed, uploaded: new Map(), lines: [], picture: null, paint: 0, cut: true, pale: null, background: [1, 1, 1] });
    this.programs = {
      mesh: this.#program(MESH_VERTEX, MESH_FRAGMENT),
      line: this.#program(LINE_VERTEX, LINE_FRAGMENT),
      picture: this.#program(PICTURE_VERTEX, PICTURE_FRAGMENT),
    };
    this.ramp = this.#texture(gl.NEAREST);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, ramp);
    this.pictureTexture = this.#texture(gl.LINEAR);
    this.lineBuffer = gl.createBuffer();
    this.pictureBuffer = gl.createBuffer();
    gl.enable(gl.DEPTH_TEST);
  }

  #program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const places = { program, uniforms: {}, attributes: {} };
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      places.uniforms[name] = gl.getUniformLocation(program, name);
    }
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_ATTRIBUTES); i++) {
      const { name } = gl.getActiveAttrib(program, i);
      const place = gl.getAttribLocation(program, name);
      if (place >= 0) places.attributes[name] = place; // gl_VertexID has none
    }
    return places;
  }

  #texture(filter) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, filter);
    for (const which of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, which, gl.CLAMP_TO_EDGE);
    return texture;
  }

  #uploadedMesh(mesh) {
    if (this.uploaded.has(mesh)) return this.uploaded.get(mesh);
    const gl = this.gl, vao = gl.createVertexArray(), at = this.programs.mesh.attributes, faces = bytesOf(mesh.faces);
    // Where a vertex is in the texture depends on the face.
    const corners = mesh.texture ? new Uint32Array(faces) : null;
    const scalars = new Uint8Array(3 * mesh.vertices);
    new Uint8Array(bytesOf(mesh.confidence)).forEach((value, i) => (scalars[3 * i] = value));
    new Uint8Array(bytesOf(mesh.seen)).forEach((value, i) => (scalars[3 * i + 1] = value));
    new Uint8Array(bytesOf(mesh.moving)).forEach((value, i) => (scalars[3 * i + 2] = value));
    gl.bindVertexArray(vao);
    const arrays = [
      ["position", new Uint16Array(bytesOf(mesh.positions)), 3, gl.UNSIGNED_SHORT], ["normal", new Int8Array(bytesOf(mesh.normals)), 3, gl.BYTE],
      ["colour", new Uint8Array(bytesOf(mesh.colours)), 3, gl.UNSIGNED_BYTE], ["scalars", scalars, 3, gl.UNSIGNED_BYTE],
    ].map(([name, values, count, kind]) => [name, corners ? rowsOf(values, count, corners) : values, count, kind]);
    if (corners) arrays.push(["place", bytesOf(mesh.texture.places), 2, gl.UNSIGNED_SHORT]);
    for (const [name, values, count, kind] of arrays) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(at[name]);
      gl.vertexAttribPointer(at[name], count, kind, true, 0, 0);
    }
    if (!corners) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    }
    gl.bindVertexArray(null);
    const ready = { vao, count: faces.byteLength / 4, gain: this.#gainOf(new Uint8Array(bytesOf(mesh.colours))), texture: null, indexed: !corners };
    if (corners) this.#decodeTexture(mesh, ready);
    this.uploaded.set(mesh, ready);
    return ready;
  }

  // Until its picture is decoded a surface has the colours of its vertices.
  async #decodeTexture(mesh, ready) {
    const gl = this.gl, image = Object.assign(new Image(), { src: `data:image/jpeg;base64,${mesh.texture.jpg}` });
    await image.decode();
    const texture = this.#texture(gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    ready.texture = texture;
    this.changed();
  }

  // Albedo has no light of its own: it is shown as bright as its bright parts allow, its median at most medium.
  #gainOf(colours) {
    const sums = [], most = [];
    for (let i = 0; i < colours.length; i += 3 * 17) {
      sums.push(colours[i] + colours[i + 1] + colours[i + 2]);
      most.push(Math.max(colours[i], colours[i + 1], colours[i + 2]));
    }
    const at = (values, share) => values.sort((a, b) => a - b)[Math.floor(share * (values.length - 1))] || 1;
    return sums.length ? Math.max(1, Math.min(3, 400 / at(sums, 0.5), 255 / at(most, 0.9))) : 1;
  }

  // Draw a mesh from a pose through a lens into what is bound. purpose and the rest: see the shader.
  #drawMesh(mesh, pose, lens, near, far, { purpose = 0, paint = 0, cut = false, lamp = false, pale = null, gain = null, depthRange = [1, 2] } = {}) {
    const gl = this.gl, { program, uniforms } = this.programs.mesh, ready = this.#uploadedMesh(mesh), { vao, count, texture } = ready;
    gl.useProgram(program);
    gl.uniform3fv(uniforms.low, mesh.low);
    gl.uniform3fv(uniforms.spread, mesh.high.map((value, k) => value - mesh.low[k]));
    gl.uniformMatrix4fv(uniforms.view, false, viewMatrix(pose));
    gl.uniformMatrix4fv(uniforms.lens, false, pinholeMatrix(lens, near, far));
    gl.uniform1i(uniforms.purpose, purpose);
    gl.uniform1i(uniforms.paint, paint);
    gl.uniform1i(uniforms.cut, cut);
    gl.uniform1i(uniforms.lamp, lamp);
    gl.uniform3f(uniforms.pale, pale?.sure ?? 0, pale?.level ?? 0, pale?.least ?? 1);
    gl.uniform1f(uniforms.gain, gain ?? ready.gain);
    gl.uniform2fv(uniforms.depthRange, depthRange);
    gl.uniform1i(uniforms.textured, texture !== null);
    gl.uniform1i(uniforms.ramp, 0);
    gl.uniform1i(uniforms.tissue, 1);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, texture ?? this.ramp);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.ramp);
    gl.bindVertexArray(vao);
    if (ready.indexed) gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
    else gl.drawArrays(gl.TRIANGLES, 0, count);
    gl.bindVertexArray(null);
  }

  #drawLines(lines, pose, lens, near, far, pixels, alpha) {
    const gl = this.gl, { program, uniforms, attributes } = this.programs.line;
    if (!lines.length) return;
    const rows = new Float32Array(11 * lines.length);
    lines.forEach(({ from, to, colour, dashed }, i) => rows.set([...from, ...to, ...colour, 1, dashed ? 1 : 0], 11 * i));
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.view, false, viewMatrix(pose));
    gl.uniformMatrix4fv(uniforms.lens, false, pinholeMatrix(lens, near, far));
    gl.uniform2f(uniforms.size, lens.width, lens.height);
    gl.uniform1f(uniforms.width, pixels);
    gl.uniform1f(uniforms.near, near);
    gl.uniform1f(uniforms.alpha, alpha);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, rows, gl.DYNAMIC_DRAW);
    for (const [name, count, offset] of [["from", 3, 0], ["to", 3, 12], ["colour", 4, 24], ["dashes", 1, 40]]) {
      gl.enableVertexAttribArray(attributes[name]);
      gl.vertexAttribPointer(attributes[name], count, gl.FLOAT, false, 44, offset);
      gl.vertexAttribDivisor(attributes[name], 1);
    }
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, lines.length);
    for (const place of Object.values(attributes)) {
      gl.vertexAttribDivisor(place, 0);
      gl.disableVertexAttribArray(place);
    }
  }

  // corners: top left, top right, bottom left, bottom right, in the world.
  #drawPicture(corners, pose, lens, near, far) {
    const gl = this.gl, { program, uniforms, attributes } = this.programs.picture;
    const rows = new Float32Array(corners.flatMap((corner, k) => [...corner, k & 1, k >> 1]));
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.view, false, viewMatrix(pose));
    gl.uniformMatrix4fv(uniforms.lens, false, pinholeMatrix(lens, near, far));
    gl.uniform1i(uniforms.picture, 0);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.pictureTexture);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.pictureBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, rows, gl.DYNAMIC_DRAW);
    for (const [name, count, offset] of [["position", 3, 0], ["place", 2, 12]]) {
      gl.enableVertexAttribArray(attributes[name]);
      gl.vertexAttribPointer(attributes[name], count, gl.FLOAT, false, 20, offset);
    }
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    for (const place of Object.values(attributes)) gl.disableVertexAttribArray(place);
  }

  // Set the picture that the camera holds up in the scene: an image, or null for none.
  setPicture(image) {
    this.picture = image;
    if (!image) return;
    this.gl.bindTexture(this.gl.TEXTURE_2D, this.pictureTexture);
    this.gl.texImage2D(this.gl.TEXTURE_2D, 0, this.gl.RGB, this.gl.RGB, this.gl.UNSIGNED_BYTE, image);
  }

  // Draw the scene: a mesh, lines {from, to, colour, dashed}, and the camera's corners, seen from a pose.
  draw(mesh, pose, { near, far, fieldOfView, lines, frustum, corners }) {
    const gl = this.gl, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const lens = lensOf(width, height, fieldOfView);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.#clear(width, height, [...this.background, 1]);
    this.#drawMesh(mesh, pose, lens, near, far, { paint: this.paint, cut: this.cut, pale: this.pale });
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.DEPTH_TEST);
    this.#drawLines(lines, pose, lens, near, far, 1.3 * ratio, 0.35);
    gl.enable(gl.DEPTH_TEST);
    this.#drawLines(lines, pose, lens, near, far, 1.6 * ratio, 1);
    if (corners && this.picture) this.#drawPicture(corners, pose, lens, near, far);
    gl.disable(gl.DEPTH_TEST);
    this.#drawLines(frustum, pose, lens, near, far, 1.5 * ratio, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
  }

  #clear(width, height, colour) {
    const gl = this.gl;
    gl.viewport(0, 0, width, height);
    gl.clearColor(...colour);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  // Return the RGBA bytes of a mesh from a pose through a lens, top row first; alpha is 0 where nothing is.
  pixels(mesh, pose, lens, near, far, options) {
    const gl = this.gl, { width, height } = lens, key = `${width}x${height}`;
    if (this.target?.key !== key) this.target = { key, ...this.#target(width, height) };
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.buffer);
    this.#clear(width, height, [0, 0, 0, 0]);
    this.#drawMesh(mesh, pose, lens, near, far, options);
    const bytes = new Uint8ClampedArray(4 * width * height), rows = new Uint8ClampedArray(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    for (let y = 0; y < height; y++) rows.set(bytes.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
    return rows;
  }

  #target(width, height) {
    const gl = this.gl, buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    for (const [place, format] of [[gl.COLOR_ATTACHMENT0, gl.RGBA8], [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24]]) {
      const store = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, store);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, store);
    }
    return { buffer };
  }
}
