// Pointing out a part of the desk: four points of the held picture, by hand or with the arrow keys.

import { make, pointer } from "./handles.js";

const WORDS = {
  plane: ["a corner of it", "the next corner, around it", "the third corner", "the last corner"],
  wall: ["where its left end meets the desk", "where its right end meets the desk", "its top right corner", "its top left corner"],
  box: ["the left corner of its base in front", "the right corner of its base in front", "the corner of its top above that", "the next corner of its top, behind"],
};
const NAMES = { plane: "Plane on the desk", wall: "Wall", box: "Box" };

export class Pointing {
  #svg;
  #connection;
  #note;
  #kind = null;
  #points = [];
  #at = null;
  #group = null;
  #played = true;

  constructor(svg, connection, note) {
    this.#svg = svg;
    this.#connection = connection;
    this.#note = note;
    svg.addEventListener("pointerdown", (event) => this.on && this.#press(event), true);
    svg.addEventListener("pointermove", (event) => this.on && this.#aim(pointer(this.#svg, event)), true);
    svg.addEventListener("keydown", (event) => this.on && this.#key(event), true);
  }

  get on() {
    return this.#kind !== null;
  }

  /** Begin with a kind; the picture is held meanwhile, for its points belong to one frame. */
  start(kind, played) {
    this.stop(false);
    this.#kind = kind;
    this.#played = played;
    this.#points = [];
    const { width, height } = this.#svg.viewBox.baseVal;
    this.#at = [width / 2, height / 2];
    this.#group = make("g", { transform: "translate(0.5 0.5)" }, this.#svg);
    this.#svg.classList.add("pointing");
    this.#svg.setAttribute("tabindex", "0");
    this.#svg.style.visibility = "";
    this.#svg.focus({ preventScroll: true });
    this.#connection.send("play", { on: false });
    this.#draw();
  }

  stop(goOn = true) {
    if (!this.on) return;
    this.#kind = null;
    this.#group.remove();
    this.#svg.classList.remove("pointing");
    this.#svg.removeAttribute("tabindex");
    this.#note.hidden = true;
    if (goOn && this.#played) this.#connection.send("play", { on: true });
  }

  #press(event) {
    if (event.button !== 0) return;
    event.preventDefault();
    event.stopPropagation();
    this.#take(pointer(this.#svg, event));
  }

  #aim(at) {
    this.#at = at;
    this.#draw();
  }

  #key(event) {
    const step = event.shiftKey ? 1 : 8;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (moves[event.key]) this.#aim(this.#at.map((value, i) => value + moves[event.key][i]));
    else if (event.key === "Enter" || event.key === " ") this.#take(this.#at);
    else if (event.key === "Backspace" && this.#points.length) this.#points.pop(), this.#draw();
    else if (event.key === "Escape") this.stop();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  #take(at) {
    this.#points.push(at);
    if (this.#points.length < 4) return this.#draw();
    this.#connection.send("outline", { kind: this.#kind, points: this.#points });
    this.stop();
  }

  #draw() {
    const unit = this.#svg.viewBox.baseVal.width / (this.#svg.clientWidth || 640);
    const [x, y] = this.#at;
    this.#group.replaceChildren();
    if (this.#points.length) make("path", { class: "pointed", d: `M${[...this.#points, this.#at].map((p) => p.join(" ")).join("L")}` }, this.#group);
    for (const [cx, cy] of this.#points) make("circle", { class: "pointed dot", cx, cy, r: 4 * unit }, this.#group);
    make("path", { class: "cross", d: `M${x - 12 * unit} ${y}h${24 * unit}M${x} ${y - 12 * unit}v${24 * unit}` }, this.#group);
    const words = `${NAMES[this.#kind]}, point ${this.#points.length + 1} of 4: ${WORDS[this.#kind][this.#points.length]}. Click, or arrows and Enter; Escape leaves it.`;
    if (this.#note.textContent !== words) this.#note.textContent = words;
    this.#note.hidden = false;
  }
}
