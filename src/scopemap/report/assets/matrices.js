// Poses as {R: 9 numbers row by row, t: 3 numbers}, camera-to-world with OpenCV axes; 4x4 matrices column by column, as WebGL takes them.

const bytesOf = (base64) => {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes.buffer;
};

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const column = (R, k) => [R[k], R[3 + k], R[6 + k]];
const rotated = (R, p) => [0, 3, 6].map((r) => R[r] * p[0] + R[r + 1] * p[1] + R[r + 2] * p[2]);
const IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1];

function product(A, B) {
  const C = new Array(9);
  for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) C[3 * r + c] = A[3 * r] * B[c] + A[3 * r + 1] * B[3 + c] + A[3 * r + 2] * B[6 + c];
  return C;
}

// Rotation about y (yaw), then about x (pitch), rad.
function turned(yaw, pitch) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return product([cy, 0, sy, 0, 1, 0, -sy, 0, cy], [1, 0, 0, 0, cp, -sp, 0, sp, cp]);
}

// World to WebGL's eye (y up, looking along -z).
function viewMatrix({ R, t }) {
  const rows = [column(R, 0), scaled(column(R, 1), -1), scaled(column(R, 2), -1)];
  const m = new Float32Array(16);
  rows.forEach((row, r) => {
    for (let c = 0; c < 3; c++) m[4 * c + r] = row[c];
    m[12 + r] = -(row[0] * t[0] + row[1] * t[1] + row[2] * t[2]);
  });
  m[15] = 1;
  return m;
}

// Eye to clip space for a pinhole camera {width, height, fx, fy, cx, cy}; the centre of the top-left pixel is (0, 0).
function pinholeMatrix(camera, near, far) {
  const m = new Float32Array(16);
  m[0] = (2 * camera.fx) / camera.width;
  m[5] = (2 * camera.fy) / camera.height;
  m[8] = 1 - (2 * (camera.cx + 0.5)) / camera.width;
  m[9] = (2 * (camera.cy + 0.5)) / camera.height - 1;
  m[10] = -(far + near) / (far - near);
  m[11] = -1;
  m[14] = (-2 * far * near) / (far - near);
  return m;
}

function lensOf(width, height, fieldOfView) {
  const f = Math.min(width, height) / 2 / Math.tan(fieldOfView / 2);
  return { width, height, fx: f, fy: f, cx: (width - 1) / 2, cy: (height - 1) / 2 };
}

// Rotation vector, degrees, of R.
function rotationVector(R) {
  const axis = [R[7] - R[5], R[2] - R[6], R[3] - R[1]];
  const s = Math.hypot(...axis) / 2, angle = Math.atan2(s, (R[0] + R[4] + R[8] - 1) / 2);
  return s < 1e-9 ? [0, 0, 0] : scaled(axis, ((angle / s) * 90) / Math.PI);
}

const transposed = (R) => [R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]];
