// The camera's geometry, as the server's: OpenCV's pinhole and distortion, X_camera = R X + t, pixel centres at integers.

/** Camera numbers of a frame's header: width, height, fx, fy, cx, cy, then k1 k2 p1 p2 [k3 [k4 k5 k6]]. */
export function cameraOf(numbers) {
  const [width, height, fx, fy, cx, cy, ...k] = numbers;
  return { width, height, fx, fy, cx, cy, k: [...k, 0, 0, 0, 0, 0, 0, 0, 0].slice(0, 8) };
}

/** Rotation (row by row) and translation of a frame's header. */
export function poseOf(numbers) {
  return numbers && { r: numbers.slice(0, 9), t: numbers.slice(9, 12) };
}

function distort([k1, k2, p1, p2, k3, k4, k5, k6], x, y) {
  const r2 = x * x + y * y;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y];
}

/** Pixel of a point of the world, and its depth; null behind the camera. */
export function project(camera, { r, t }, [x, y, z]) {
  const depth = r[6] * x + r[7] * y + r[8] * z + t[2];
  if (depth < 1e-3) return null;
  const [u, v] = distort(camera.k, (r[0] * x + r[1] * y + r[2] * z + t[0]) / depth, (r[3] * x + r[4] * y + r[5] * z + t[1]) / depth);
  return [camera.fx * u + camera.cx, camera.fy * v + camera.cy, depth];
}

/** Where the camera stands in the world. */
export function cameraPosition({ r, t }) {
  return [0, 1, 2].map((i) => -(r[i] * t[0] + r[3 + i] * t[1] + r[6 + i] * t[2]));
}

/** A direction of the camera's frame in the world's. */
export function toWorld({ r }, [x, y, z]) {
  return [0, 1, 2].map((i) => r[i] * x + r[3 + i] * y + r[6 + i] * z);
}

/** Where the ray through a pixel meets the plane at height z; null if it does not, or farther than 5 m away. */
export function onPlane(camera, pose, u, v, z) {
  const target = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy];
  let [x, y] = target;
  for (let i = 0; i < 8; i++) {
    const [dx, dy] = distort(camera.k, x, y);
    x += target[0] - dx;
    y += target[1] - dy;
  }
  const from = cameraPosition(pose);
  const way = toWorld(pose, [x, y, 1]);
  const distance = (z - from[2]) / way[2];
  if (!(distance > 0)) return null;
  const point = [from[0] + distance * way[0], from[1] + distance * way[1], z];
  return Math.hypot(point[0], point[1]) < 5 ? point : null;
}

/** The camera's right and away, along the desk: unit vectors (x, y). */
export function deskAxes(pose) {
  const right = pose ? toWorld(pose, [1, 0, 0]) : [1, 0, 0];
  const size = Math.hypot(right[0], right[1]) || 1;
  const [x, y] = [right[0] / size, right[1] / size];
  const away = pose ? toWorld(pose, [0, 0, 1]) : [0, 1, 0];
  const sign = -y * away[0] + x * away[1] >= 0 ? 1 : -1;
  return { right: [x, y], away: [-y * sign, x * sign] };
}
