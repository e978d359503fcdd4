// The environment: the map of all directions as it comes, and as a mirror ball that stands where the camera looks.

import { toWorld } from "./geometry.js";

export class Light {
  #latlong;
  #ball;
  #note;
  #map = null;
  #pose = null;
  #stale = false;

  constructor(latlong, ball, note) {
    this.#latlong = latlong;
    this.#ball = ball;
    this.#note = note;
  }

  set pose(pose) {
    this.#pose = pose ?? this.#pose;
    this.#stale = true;
  }

  async take(message) {
    this.#note.textContent = message.known
      ? "Linear light, tone-mapped so that clipped light is visible. Left: as a mirror ball in the camera's view. Right: all directions, up at the top, the marker's right in the middle."
      : "Not captured: no stage of this scene reads it, or the marker has not been seen.";
    if (!message.known) {
      this.#map = null;
      for (const canvas of [this.#latlong, this.#ball]) canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
      return;
    }
    const picture = await createImageBitmap(new Blob([message.pictures[0]], { type: "image/png" }));
    this.#latlong.width = picture.width;
    this.#latlong.height = picture.height;
    const context = this.#latlong.getContext("2d", { willReadFrequently: true });
    context.drawImage(picture, 0, 0);
    this.#map = context.getImageData(0, 0, picture.width, picture.height);
    picture.close();
    this.#stale = true;
  }

  /** Draw the ball, if anything has changed and it can be seen. */
  draw() {
    if (!this.#stale || !this.#map || !this.#ball.offsetParent) return;
    this.#stale = false;
    const size = this.#ball.width;
    const context = this.#ball.getContext("2d");
    const out = context.createImageData(size, size);
    const { data, width, height } = this.#map;
    const pose = this.#pose ?? { r: [1, 0, 0, 0, -1, 0, 0, 0, -1] };
    for (let row = 0; row < size; row++) {
      for (let column = 0; column < size; column++) {
        const x = ((column + 0.5) / size) * 2 - 1;
        const y = ((row + 0.5) / size) * 2 - 1;
        const r2 = x * x + y * y;
        if (r2 >= 1) continue;
        // The camera looks along +z; the normal faces it, and a ray (0, 0, 1) leaves as d - 2 (d . n) n.
        const z = -Math.sqrt(1 - r2);
        const way = toWorld(pose, [-2 * z * x, -2 * z * y, 1 - 2 * z * z]);
        const i = Math.min(Math.floor((Math.acos(Math.max(-1, Math.min(1, way[2]))) / Math.PI) * height), height - 1);
        const j = Math.min(Math.floor((Math.atan2(way[1], way[0]) / Math.PI + 1) * 0.5 * width), width - 1);
        const from = 4 * (i * width + j);
        const to = 4 * (row * size + column);
        for (let c = 0; c < 3; c++) out.data[to + c] = data[from + c];
        // A soft rim, one and a half pixels wide.
        out.data[to + 3] = 255 * Math.min(1, ((1 - Math.sqrt(r2)) * size) / 3);
      }
    }
    context.putImageData(out, 0, 0);
  }
}
