// The connection: messages in and out, the server's clock, and coming back after a loss.

const token = new URLSearchParams(location.search).get("token");
const query = token ? `?token=${encodeURIComponent(token)}` : "";

// How far clocks go apart, milliseconds a millisecond: quartz does a tenth of it.
const DRIFT = 1e-3;

export const codeUrl = `address.svg${query}`;
export const lightUrl = `light.exr${query || "?"}&axes=z-up`;
export const downloadUrl = (name) => `download/${name}${query}`;

/** Hand the program a file; whether it took it, and what it says. */
export async function dropFile(file) {
  try {
    const answer = await fetch(`drop/${encodeURIComponent(file.name.slice(-120))}${query}`, { method: "POST", body: file });
    return { ok: answer.ok, words: (await answer.text()).trim() };
  } catch {
    return { ok: false, words: `${file.name} could not be sent; it may be too large.` };
  }
}

export class Connection extends EventTarget {
  /** Milliseconds to add to performance.now() for the server's clock. */
  offset = null;
  #socket = null;
  // What was sent cannot have come before it was sent: that bounds the offset from both sides.
  #offsets = { low: -Infinity, high: Infinity, at: 0 };
  #edited = -Infinity;
  #wait = 500;
  #edits = new Map();
  #flushing = false;

  open() {
    const url = new URL("live" + query, location.href);
    url.protocol = url.protocol.replace("http", "ws");
    const socket = new WebSocket(url);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    socket.onopen = () => {
      this.#wait = 500;
      this.#offsets = { low: -Infinity, high: Infinity, at: 0 };
      this.#edited = -Infinity;
      this.#emit("open");
      this.#ping();
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.#text(JSON.parse(data));
      else this.#binary(data);
    };
    socket.onclose = ({ code, reason }) => {
      this.#emit("lost", { code, reason });
      setTimeout(() => this.open(), this.#wait);
      this.#wait = Math.min(this.#wait * 1.7, 8000);
    };
  }

  get ready() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Whether the scene that the program tells has all of this page's edits. */
  get settled() {
    return !this.#edits.size && this.#edited === -Infinity;
  }

  get backlog() {
    return this.#socket?.bufferedAmount ?? 0;
  }

  send(type, fields = {}) {
    if (this.ready) this.#socket.send(JSON.stringify({ type, ...fields }));
  }

  sendBinary(data) {
    if (this.ready) this.#socket.send(data);
  }

  /** Change a value of the scene; of several changes of one value within 30 ms only the last is sent. */
  set(part, index, key, value) {
    this.#edits.set(`${part} ${index} ${key}`, { part, index, key, value });
    if (this.#flushing) return;
    this.#flushing = true;
    this.#flush();
    setTimeout(() => {
      this.#flushing = false;
      this.#flush();
    }, 30);
  }

  #flush() {
    if (!this.#edits.size) return;
    for (const edit of this.#edits.values()) this.send("set", edit);
    this.#edits.clear();
    // Answered after the edits: until then a scene that arrives may be older than they are.
    this.#edited = performance.now();
    this.send("ping", { sent: this.#edited });
  }

  #emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  #ping() {
    if (!this.ready) return;
    this.send("ping", { sent: performance.now() });
    setTimeout(() => this.#ping(), this.offset === null ? 200 : 3000);
  }

  #text(message) {
    if (message.type === "pong") {
      this.#bound(message.clock, message.sent);
      if (this.#edited <= message.sent) this.#edited = -Infinity;
      if (this.settled) this.#emit("settled");
      return;
    }
    this.#emit(message.type, message);
  }

  /** Take in that the server's clock had a value before now, and where it is known, after something was sent. */
  #bound(clock, sent = -Infinity) {
    const now = performance.now();
    const [low, high] = [clock - now, clock - sent];
    const drift = DRIFT * (now - this.#offsets.at);
    const bounds = { low: Math.max(low, this.#offsets.low - drift), high: Math.min(high, this.#offsets.high + drift), at: now };
    // Contradicted: one of the two machines has slept.
    this.#offsets = bounds.low <= bounds.high ? bounds : { low, high, at: now };
    const middle = (this.#offsets.low + this.#offsets.high) / 2;
    if (Number.isFinite(middle)) this.offset = middle;
  }

  #binary(data) {
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    let place = 4 + length;
    if (header.taken !== undefined) this.#bound(header.taken);
    header.pictures = header.sizes.map((size) => new Uint8Array(data, place, ((place += size), size)));
    this.#emit(header.type, header);
  }
}
