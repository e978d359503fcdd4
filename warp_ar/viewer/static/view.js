// The picture: decodes frames, draws them with the split, and measures how late and how often they are shown.

const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];
const WINDOW = 2000; // milliseconds that rate and latency are of: longer, and they tell of what was before

export class View extends EventTarget {
  split = 0.5;
  /** What is measured: frames shown in all, per second, and milliseconds from capture to screen. */
  stats = { shown: 0, fps: 0, latency: null, id: 0, stamped: false, plan: 0 };
  #canvas;
  #context;
  #connection;
  #last = null;
  #times = [];
  #delays = [];

  constructor(canvas, connection) {
    super();
    this.#canvas = canvas;
    this.#context = canvas.getContext("2d", { alpha: false });
    this.#connection = connection;
    connection.addEventListener("frame", ({ detail }) => this.#take(detail));
    connection.addEventListener("lost", () => {
      [this.#times, this.#delays] = [[], []];
      Object.assign(this.stats, { fps: 0, latency: null });
    });
  }

  async #take(frame) {
    let pictures = [];
    try {
      pictures = await Promise.all(frame.pictures.map((data) => createImageBitmap(new Blob([data], { type: "image/jpeg" }))));
    } finally {
      this.#connection.send("ack", { id: frame.id });
    }
    if (this.#last && frame.id < this.#last.frame.id) {
      // A newer one was quicker to decode. Ids start again with a new server.
      if (this.#last.frame.id - frame.id < 10) return pictures.forEach((picture) => picture.close());
    }
    this.#last?.pictures.forEach((picture) => picture.close());
    this.#last = { frame, pictures };
    this.draw();
    this.#measure(frame);
    this.dispatchEvent(new CustomEvent("shown", { detail: frame }));
  }

  /** Pictures of the newest frame: lit, and what it is compared with. */
  get pictures() {
    return this.#last?.pictures ?? [];
  }

  draw() {
    if (!this.#last) return;
    const [image, other] = this.#last.pictures;
    const canvas = this.#canvas;
    if (canvas.width !== image.width || canvas.height !== image.height) {
      canvas.width = image.width;
      canvas.height = image.height;
      this.dispatchEvent(new Event("resize"));
    }
    this.#context.drawImage(image, 0, 0);
    if (other) {
      const left = Math.round(this.split * canvas.width);
      if (left < canvas.width) this.#context.drawImage(other, left, 0, canvas.width - left, canvas.height, left, 0, canvas.width - left, canvas.height);
    }
  }

  #measure(frame) {
    const { stats } = this;
    // The frame is on the screen after the next refresh: that is when its time is taken.
    requestAnimationFrame((now) => {
      const from = frame.stamp ?? (this.#connection.offset === null ? null : frame.taken - this.#connection.offset);
      if (from !== null) {
        if (stats.stamped !== (frame.stamp !== null)) this.#delays = [];
        stats.stamped = frame.stamp !== null;
        const shown = Math.max(performance.now(), now);
        this.#delays = this.#delays.filter(([at]) => at > shown - WINDOW);
        this.#delays.push([shown, shown - from]);
        stats.latency = median(this.#delays.map(([, delay]) => delay));
      }
    });
    const now = performance.now();
    this.#times.push(now);
    while (this.#times.length > 2 && this.#times[0] < now - WINDOW) this.#times.shift();
    const span = now - this.#times[0];
    stats.fps = span > 0 ? ((this.#times.length - 1) * 1000) / span : 0;
    stats.shown += 1;
    stats.id = frame.id;
    stats.plan = frame.plan;
  }
}
