// This browser's camera: pictures of it go to the server as fast as it lights them, the newest each time. The server says
// when it has begun with one, and how long it expects to be busy: the next is taken just in time for it.

const LONG_SIDE = 640;
const QUALITY = 0.85;
const PATIENCE = 1000;

export class Capture extends EventTarget {
  #connection;
  #video;
  #canvas = document.createElement("canvas");
  #stream = null;
  #id = 0;
  #announced = "";
  #lock = null;
  /** When the next picture may be taken, on performance.now(). */
  #from = 0;

  constructor(connection, video) {
    super();
    this.#connection = connection;
    this.#video = video;
    connection.addEventListener("taken", ({ detail }) => {
      if (detail.id === this.#id) this.#from = performance.now() + detail.wait;
    });
    video.addEventListener("resize", () => this.#fit());
    document.addEventListener("visibilitychange", () => this.#stream && !document.hidden && this.#stayAwake());
    connection.addEventListener("open", () => {
      this.#from = 0;
      if (this.#stream) this.#announce();
    });
  }

  get on() {
    return this.#stream !== null;
  }

  async start() {
    if (!navigator.mediaDevices?.getUserMedia) {
      throw new Error("browsers open a camera only to this machine or over https: start the program with --tls, or forward its port to this machine");
    }
    const video = { width: { ideal: 640 }, height: { ideal: 480 }, frameRate: { ideal: 30 }, facingMode: "environment" };
    this.#stream = await navigator.mediaDevices.getUserMedia({ video, audio: false });
    this.#video.srcObject = this.#stream;
    await this.#video.play();
    this.#stream.getVideoTracks()[0].addEventListener("ended", () => this.stop());
    this.#fit();
    this.#next();
    this.#stayAwake();
  }

  /** Take pictures of the video's shape, which changes when a phone is turned. */
  #fit() {
    const { videoWidth, videoHeight } = this.#video;
    if (!this.#stream || !videoWidth) return;
    const scale = Math.min(1, LONG_SIDE / Math.max(videoWidth, videoHeight));
    const [width, height] = [videoWidth, videoHeight].map((side) => 2 * Math.round((scale * side) / 2));
    if (this.#announced === `${width} ${height}`) return;
    this.#announced = `${width} ${height}`;
    [this.#canvas.width, this.#canvas.height] = [width, height];
    this.#announce();
  }

  /** Keep a phone's screen on; where that is not offered or not allowed, it goes off as it always does. */
  async #stayAwake() {
    this.#lock = await navigator.wakeLock?.request("screen").catch(() => null);
    if (!this.#stream) this.#lock?.release();
  }

  stop() {
    if (!this.#stream) return;
    this.#stream.getTracks().forEach((track) => track.stop());
    this.#stream = null;
    this.#announced = "";
    this.#lock?.release();
    this.#video.srcObject = null;
    this.#connection.send("no_camera");
    this.dispatchEvent(new Event("stopped"));
  }

  #announce() {
    this.#connection.send("camera", { width: this.#canvas.width, height: this.#canvas.height });
  }

  #next() {
    if (!this.#stream) return;
    const take = (now, about) => {
      this.#take(about?.captureTime ?? now).finally(() => this.#next());
    };
    if (this.#video.requestVideoFrameCallback) this.#video.requestVideoFrameCallback(take);
    else setTimeout(() => take(performance.now()), 33);
  }

  async #take(stamp) {
    if (performance.now() < this.#from || this.#connection.backlog > 0 || !this.#connection.ready) return;
    const { width, height } = this.#canvas;
    this.#canvas.getContext("2d", { alpha: false }).drawImage(this.#video, 0, 0, width, height);
    const blob = await new Promise((done) => this.#canvas.toBlob(done, "image/jpeg", QUALITY));
    const data = blob && new Uint8Array(await blob.arrayBuffer());
    // Switched off or turned meanwhile: the server expects another size by now.
    if (!data || !this.#stream || this.#canvas.width !== width || this.#canvas.height !== height) return;
    const message = new Uint8Array(12 + data.length);
    const view = new DataView(message.buffer);
    view.setFloat64(0, stamp, true);
    view.setUint32(8, (this.#id = (this.#id + 1) >>> 0), true);
    message.set(data, 12);
    // Should the answer be lost, the picture goes on all the same.
    this.#from = performance.now() + PATIENCE;
    this.#connection.sendBinary(message);
  }
}
