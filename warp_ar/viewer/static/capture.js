// This browser's camera: pictures of it go to the server as fast as the server takes them, one at a time, the newest.

const LONG_SIDE = 640;
const QUALITY = 0.85;

export class Capture extends EventTarget {
  #connection;
  #video;
  #canvas = document.createElement("canvas");
  #stream = null;
  #waiting = 0;
  #id = 0;

  constructor(connection, video) {
    super();
    this.#connection = connection;
    this.#video = video;
    connection.addEventListener("taken", () => (this.#waiting = Math.max(0, this.#waiting - 1)));
    connection.addEventListener("open", () => {
      this.#waiting = 0;
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
    const scale = Math.min(1, LONG_SIDE / Math.max(this.#video.videoWidth, this.#video.videoHeight));
    this.#canvas.width = 2 * Math.round((scale * this.#video.videoWidth) / 2);
    this.#canvas.height = 2 * Math.round((scale * this.#video.videoHeight) / 2);
    this.#announce();
    this.#next();
  }

  stop() {
    if (!this.#stream) return;
    this.#stream.getTracks().forEach((track) => track.stop());
    this.#stream = null;
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
    if (this.#waiting >= 2 || this.#connection.backlog > 0 || !this.#connection.ready) return;
    const { width, height } = this.#canvas;
    this.#canvas.getContext("2d", { alpha: false }).drawImage(this.#video, 0, 0, width, height);
    const blob = await new Promise((done) => this.#canvas.toBlob(done, "image/jpeg", QUALITY));
    if (!blob || !this.#stream) return;
    const message = new Uint8Array(12 + blob.size);
    const view = new DataView(message.buffer);
    view.setFloat64(0, stamp, true);
    view.setUint32(8, (this.#id = (this.#id + 1) >>> 0), true);
    message.set(new Uint8Array(await blob.arrayBuffer()), 12);
    this.#waiting += 1;
    this.#connection.sendBinary(message);
  }
}
