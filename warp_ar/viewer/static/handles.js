// Handles on the desk: rings around objects, lights on stems, dragged with pointer, wheel or keys.

import { deskAxes, onPlane, project } from "./geometry.js";

/** An element of SVG. */
export const make = (name, attributes = {}, parent = null) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  parent?.append(element);
  return element;
};
/** Where an event is in the picture that an SVG covers, pixels: centres lie at integers. */
export const pointer = (svg, event) => {
  const box = svg.getBoundingClientRect();
  const { width, height } = svg.viewBox.baseVal;
  return [((event.clientX - box.left) / box.width) * width - 0.5, ((event.clientY - box.top) / box.height) * height - 0.5];
};
const css = (color) => {
  const top = Math.max(...color, 1e-6);
  return `rgb(${color.map((c) => Math.round(255 * Math.pow(Math.min(c / top, 1), 1 / 2.2))).join(" ")})`;
};
const rounded = (value) => (Array.isArray(value) ? value.map(rounded) : Math.round(value * 1e5) / 1e5);
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const SUN = 0.22; // metres from the marker at which a directional light's handle hangs

export const lightColor = css;

export class Handles extends EventTarget {
  #svg;
  #connection;
  #items = [];
  #camera = null;
  #pose = null;
  #scene = null;
  #drag = null;
  #pressed = null;
  #grips = new WeakMap();
  #fingers = new Map();
  #wheeled = null;
  #selected = null;
  #visible = true;

  constructor(svg, connection) {
    super();
    this.#svg = svg;
    this.#connection = connection;
    svg.addEventListener("pointermove", (event) => this.#move(event));
    for (const type of ["pointerup", "pointercancel"]) {
      svg.addEventListener(type, (event) => {
        this.#fingers.delete(event.pointerId);
        this.#release();
      });
    }
    svg.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    svg.addEventListener("pointerdown", (event) => this.#press(event));
    connection.addEventListener("lost", () => {
      this.#pressed = null;
      this.#fingers.clear();
      this.#release();
    });
    connection.addEventListener("picked", ({ detail }) => this.#picked(detail));
  }

  /** Whether something is being dragged: the scene is the page's until it is let go. */
  get busy() {
    return this.#drag !== null || this.#pressed !== null;
  }

  /** Key of the part that is dragged; null while nothing is, undefined until a press is answered. */
  get dragged() {
    return this.#drag ? this.#drag.item.key : this.#pressed ? undefined : null;
  }

  set visible(on) {
    this.#visible = on;
    this.#place();
  }

  set selected(key) {
    this.#selected = key;
    for (const item of this.#items) item.group.classList.toggle("on", item.key === key);
    if (this.#items.some((item) => item.part === "proxy")) this.#place();
  }

  set scene(scene) {
    const shape = JSON.stringify([scene.objects.map((o) => o.shape), scene.lights.map((l) => [l.kind, !!l.target]), scene.proxies.map((p) => p.shape)]);
    const same = this.#scene && shape === this.#scene.shape;
    this.#scene = { ...scene, shape };
    if (!same) {
      // The keyboard's place stays: on the same part, else on the one that has taken its number, or the picture's last.
      const key = this.#svg.contains(document.activeElement) ? document.activeElement.dataset.key : null;
      this.#rebuild();
      if (key) (this.#items.find((item) => item.key === key) ?? this.#items.at(-1))?.group.focus({ preventScroll: true });
    }
    this.selected = this.#selected;
    this.#place();
  }

  frame(camera, pose) {
    this.#camera = camera;
    this.#pose = pose;
    this.#place();
  }

  #part(item) {
    return this.#scene[{ object: "objects", light: "lights", proxy: "proxies" }[item.part]][item.index];
  }

  #rebuild() {
    this.#svg.replaceChildren();
    this.#items = [];
    // Shapes of the desk first: they are large, and what stands on them is to be hit.
    this.#scene.proxies.forEach((proxy, index) => {
      const item = this.#group("proxy", index, `${proxy.shape} of the desk ${index + 1}`);
      item.face = this.#grip(item, "at", make("path", { class: "face" }, item.group));
      item.edge = make("path", { class: "edge" }, item.group);
    });
    // Lights last: a light or its target over an object's ring is the smaller one to hit.
    this.#scene.objects.forEach((object, index) => {
      const item = this.#group("object", index, `${object.file ?? object.shape} ${index + 1}`);
      item.halo = make("path", { class: "halo" }, item.group);
      item.ring = this.#grip(item, "at", make("path", { class: "ring" }, item.group));
      item.turn = make("circle", { class: "turn", r: 6 }, item.group);
      item.turnHit = this.#grip(item, "turn", make("circle", { class: "hit", r: 20 }, item.group));
      item.scale = make("circle", { class: "turn scale", r: 6 }, item.group);
      item.scaleHit = this.#grip(item, "scale", make("circle", { class: "hit", r: 20 }, item.group));
    });
    this.#scene.lights.forEach((light, index) => {
      const item = this.#group("light", index, `${light.kind} light ${index + 1}`);
      item.stem = make("line", { class: "stem" }, item.group);
      item.floor = this.#grip(item, "floor", make("path", { class: "ring" }, item.group));
      if (light.target) {
        item.beam = make("line", { class: "stem" }, item.group);
        item.target = make("circle", { class: "turn", r: 5 }, item.group);
        item.targetHit = this.#grip(item, "target", make("circle", { class: "hit", r: 18 }, item.group));
      }
      item.bulb = make("circle", { class: "bulb", r: 10 }, item.group);
      item.hit = this.#grip(item, "at", make("circle", { class: "hit", r: 24 }, item.group));
    });
  }

  #group(part, index, label) {
    const group = make("g", { class: "part", tabindex: 0, role: "button", "aria-label": `${label}: arrows move it` }, this.#svg);
    const item = { part, index, key: `${part} ${index}`, group };
    group.dataset.key = item.key;
    group.addEventListener("focus", () => this.#select(item.key));
    group.addEventListener("keydown", (event) => this.#key(event, item));
    this.#items.push(item);
    return item;
  }

  #grip(item, grip, element) {
    this.#grips.set(element, { item, grip });
    return element;
  }

  #circle([x, y], radius, z) {
    const points = [];
    for (let i = 0; i < 40; i++) {
      const angle = (i * Math.PI) / 20;
      const at = project(this.#camera, this.#pose, [x + radius * Math.cos(angle), y + radius * Math.sin(angle), z]);
      if (!at) return "";
      points.push(`${(at[0] + 0.5).toFixed(1)} ${(at[1] + 0.5).toFixed(1)}`);
    }
    return `M${points.join("L")}Z`;
  }

  #lightAt(light) {
    if (light.kind !== "directional") return light.at;
    const size = Math.hypot(...light.direction) || 1;
    return light.direction.map((d) => (-SUN * d) / size);
  }

  #place() {
    const shown = this.#visible && this.#camera && this.#pose && this.#scene;
    this.#svg.style.visibility = shown || this.#svg.classList.contains("pointing") ? "" : "hidden";
    if (!shown) return;
    const { width, height } = this.#camera;
    const box = `0 0 ${width} ${height}`;
    if (this.#svg.getAttribute("viewBox") !== box) this.#svg.setAttribute("viewBox", box);
    // Sizes are in pixels of the screen, whatever the picture's.
    const unit = width / (this.#svg.clientWidth || width);
    for (const item of this.#items) {
      const part = this.#part(item);
      // A shape of the desk shows its edges while it is chosen: it is there to be seen anyway.
      const seen = part.visible && (item.part !== "proxy" || item.key === this.#selected);
      item.group.style.display = seen ? "" : "none";
      if (!seen) continue;
      if (item.part === "proxy") this.#placeProxy(item, part);
      else if (item.part === "object") this.#placeObject(item, part, unit);
      else this.#placeLight(item, part, unit);
    }
  }

  #placeObject(item, object, unit) {
    const radius = Math.max(object.reach * 1.1, 0.012);
    const path = this.#circle(object.at, radius, 0);
    item.ring.setAttribute("d", path);
    item.halo.setAttribute("d", path);
    const angle = (object.rotate[2] * Math.PI) / 180;
    const outside = 1.15 * radius + 0.012; // clear of the object's own pixels, which move it
    const [x, y] = [outside * Math.cos(angle), outside * Math.sin(angle)];
    const [turn, scale] = [1, -1].map((side) => project(this.#camera, this.#pose, [object.at[0] + side * x, object.at[1] + side * y, 0]));
    for (const [element, at, size] of [[item.turn, turn, 5.5], [item.turnHit, turn, 22], [item.scale, scale, 5.5], [item.scaleHit, scale, 22]]) put(element, at, size * unit);
  }

  #placeProxy(item, proxy) {
    const path = (points, close) => {
      const seen = points.map((point) => project(this.#camera, this.#pose, point));
      return seen.every(Boolean) ? `M${seen.map(([x, y]) => `${(x + 0.5).toFixed(1)} ${(y + 0.5).toFixed(1)}`).join("L")}${close ? "Z" : ""}` : "";
    };
    const corners = proxyCorners(proxy);
    const box = corners.length === 8;
    const top = box ? corners.slice(4) : corners;
    const uprights = box ? corners.slice(0, 4).map((corner, i) => path([corner, corners[i + 4]], false)).join("") : "";
    item.edge.setAttribute("d", path(top, true) + (box ? path(corners.slice(0, 4), true) : "") + uprights);
    item.face.setAttribute("d", path(top, true));
  }

  #placeLight(item, light, unit) {
    const at = this.#lightAt(light);
    const bulb = project(this.#camera, this.#pose, at);
    const floor = project(this.#camera, this.#pose, light.kind === "directional" ? [0, 0, 0] : [at[0], at[1], 0]);
    // A light above the picture hangs at its border, where it can still be taken.
    const rim = 14 * unit;
    const held = bulb && [clamp(bulb[0], rim, this.#camera.width - rim), clamp(bulb[1], rim, this.#camera.height - rim)];
    put(item.bulb, held, 9 * unit);
    put(item.hit, held, 24 * unit);
    item.group.classList.toggle("beyond", !!bulb && (held[0] !== bulb[0] || held[1] !== bulb[1]));
    item.bulb.setAttribute("fill", css(light.color));
    line(item.stem, held, floor);
    item.floor.setAttribute("d", light.kind === "directional" ? "" : this.#circle(at, 0.014, 0));
    if (item.target) {
      const target = project(this.#camera, this.#pose, light.target);
      put(item.target, target, 4.5 * unit);
      put(item.targetHit, target, 22 * unit);
      line(item.beam, held, target);
    }
  }

  #select(key) {
    this.selected = key;
    this.dispatchEvent(new CustomEvent("select", { detail: key }));
  }

  /** An object is taken by the pixels that show it, which the program knows; handles by what is left. */
  #press(event) {
    if (event.button !== 0 || !this.#pose || this.#svg.classList.contains("pointing")) return;
    event.preventDefault();
    this.#svg.setPointerCapture(event.pointerId);
    const [u, v] = pointer(this.#svg, event);
    this.#fingers.set(event.pointerId, [u, v]);
    if (this.#pressed) return;
    const grip = this.#grips.get(event.target);
    this.#pressed = { u, v, grip, moved: event, up: false };
    const unit = this.#camera.width / (this.#svg.clientWidth || this.#camera.width);
    // A chosen light is taken over an object too, by what is drawn of it.
    const chosen = grip?.item.part === "light" && grip.item.key === this.#selected;
    const drawn = chosen && project(this.#camera, this.#pose, grip.grip === "target" ? this.#part(grip.item).target : this.#lightAt(this.#part(grip.item)));
    if (!this.#connection.ready || (drawn && Math.hypot(drawn[0] - u, drawn[1] - v) < 9 * unit)) return this.#take(grip);
    this.#connection.send("pick", { x: u, y: v, reach: event.pointerType === "touch" ? 8 * unit : 0 });
  }

  #picked({ x, y, object }) {
    const [pressed, wheeled] = [this.#pressed, this.#wheeled];
    if (wheeled?.u === x && wheeled.v === y) {
      wheeled.key = object === null ? wheeled.drawn : `object ${object}`;
      this.#turnWheel();
    }
    if (!pressed || this.#drag || x !== pressed.u || y !== pressed.v) return;
    const item = this.#items.find((one) => one.key === `object ${object}`);
    this.#take(item ? { item, grip: "at" } : pressed.grip);
  }

  #take(held) {
    const { u, v, moved, up } = this.#pressed;
    if (!held) {
      this.#pressed = null;
      return this.#select(null);
    }
    const { item, grip } = held;
    const part = this.#part(item);
    const point = item.part === "proxy" ? part.at : item.part === "object" || grip === "floor" ? [part.at[0], part.at[1], 0] : grip === "target" ? part.target : this.#lightAt(part);
    const seen = project(this.#camera, this.#pose, point) ?? [0, 0];
    this.#drag = { item, grip, point, off: [seen[0] - u, seen[1] - v], height: part.at[2], from: v, away: this.#away(part, u, v), scale: part.scale };
    item.group.focus({ preventScroll: true });
    this.#select(item.key);
    // The hand may have gone on, or up, before the answer was there.
    if (pointer(this.#svg, moved).some((value, i) => Math.abs(value - [u, v][i]) > 0.5)) this.#move(moved);
    if (up) this.#release();
  }

  /** Distance along the desk from a part to what a pixel shows of it, metres. */
  #away(part, u, v) {
    const at = onPlane(this.#camera, this.#pose, u, v, 0);
    return at ? Math.max(Math.hypot(at[0] - part.at[0], at[1] - part.at[1]), 0.005) : 0.1;
  }

  /** Two fingers on an object: their distance is its size, their direction its turn. */
  #pinch({ item }, part) {
    const [[a, b], [c, d]] = this.#fingers.values();
    const [distance, angle] = [Math.hypot(c - a, d - b), (Math.atan2(d - b, c - a) * 180) / Math.PI];
    const from = (this.#drag.pinch ??= { distance, angle, scale: part.scale, turn: part.rotate[2] });
    this.#put(item, "scale", Math.max((from.scale * distance) / Math.max(from.distance, 1), 1e-4));
    this.#put(item, "rotate", [part.rotate[0], part.rotate[1], from.turn + from.angle - angle]);
  }

  #move(event) {
    if (this.#pressed && !(this.#fingers.size > 1)) this.#pressed.moved = event;
    if (!this.#drag || !this.#pose) return;
    const { item, grip, point, off, from, height, away, scale } = this.#drag;
    const part = this.#part(item);
    const [u, v] = pointer(this.#svg, event);
    if (this.#fingers.has(event.pointerId)) this.#fingers.set(event.pointerId, [u, v]);
    if (this.#fingers.size > 1 && item.part === "object") return this.#pinch(this.#drag, part);
    if (grip === "scale") return this.#put(item, "scale", Math.max((scale * this.#away(part, u, v)) / away, 1e-4));
    if (grip === "turn") {
      const at = onPlane(this.#camera, this.#pose, u, v, 0);
      if (at) this.#put(item, "rotate", [part.rotate[0], part.rotate[1], (Math.atan2(at[1] - part.at[1], at[0] - part.at[0]) * 180) / Math.PI]);
      return;
    }
    if (event.shiftKey && grip === "at" && part.kind !== "directional") {
      this.#put(item, "at", [part.at[0], part.at[1], clamp(height + (from - v) * 0.001, -1, 3)]);
      return;
    }
    const at = onPlane(this.#camera, this.#pose, u + off[0], v + off[1], point[2]);
    if (!at) return;
    const [x, y] = [clamp(at[0], -3, 3), clamp(at[1], -3, 3)];
    if (grip === "target") this.#put(item, "target", [x, y, part.target[2]]);
    else if (part.kind === "directional") this.#put(item, "direction", [-x, -y, -point[2]]);
    else this.#put(item, "at", [x, y, part.at[2]]);
  }

  #release() {
    if (this.#pressed && !this.#drag) return void (this.#pressed.up = true);
    this.#pressed = null;
    if (!this.#drag) return;
    this.#drag = null;
    this.dispatchEvent(new Event("released"));
  }

  /** The wheel turns the object, or sets the height of the light, that is under it. */
  #wheel(event) {
    if (!this.#pose) return;
    event.preventDefault();
    const step = clamp(event.deltaY * (event.deltaMode === 1 ? 30 : 1), -240, 240);
    const [u, v] = pointer(this.#svg, event);
    if (this.#wheeled && Math.hypot(this.#wheeled.u - u, this.#wheeled.v - v) < 1) {
      this.#wheeled.step += step;
      return this.#turnWheel();
    }
    const drawn = event.target.closest?.(".part")?.dataset.key;
    this.#wheeled = { u, v, step, drawn, raises: event.shiftKey };
    this.#connection.send("pick", { x: u, y: v, reach: 0 });
  }

  #turnWheel() {
    const { key, step, raises } = this.#wheeled;
    const item = this.#items.find((one) => one.key === key);
    if (!item) return;
    this.#wheeled.step = 0;
    if (item.part === "light") this.#raise(item, -step * 0.0002);
    else if (raises) this.#raise(item, -step * 0.0001);
    else this.#turn(item, step * 0.06);
    this.#select(item.key);
  }

  #raise(item, by) {
    const part = this.#part(item);
    if (part.kind === "directional") {
      const [x, y, z] = this.#lightAt(part);
      this.#put(item, "direction", [-x, -y, -clamp(z + by, 0.01, 3)]);
    } else this.#put(item, "at", [part.at[0], part.at[1], clamp(part.at[2] + by, item.part === "light" ? 0.01 : -1, 3)]);
  }

  #turn(item, degrees) {
    const part = this.#part(item);
    if (item.part !== "light") this.#put(item, "rotate", [part.rotate[0], part.rotate[1], part.rotate[2] + degrees]);
  }

  #key(event, item) {
    const step = event.shiftKey ? 0.001 : 0.006;
    const axes = deskAxes(this.#pose);
    const arrows = { ArrowRight: axes.right, ArrowLeft: axes.right.map((a) => -a), ArrowUp: axes.away, ArrowDown: axes.away.map((a) => -a) };
    const part = this.#part(item);
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (arrows[event.key]) {
      const [x, y] = arrows[event.key];
      if (part.kind === "directional") {
        const at = this.#lightAt(part);
        this.#put(item, "direction", [-at[0] - x * step, -at[1] - y * step, -at[2]]);
      } else this.#put(item, "at", [part.at[0] + x * step, part.at[1] + y * step, part.at[2]]);
    } else if (event.key === "PageUp" || event.key === "PageDown") this.#raise(item, event.key === "PageUp" ? step : -step);
    else if (event.key === "[" || event.key === "]") this.#turn(item, event.key === "]" ? 5 : -5);
    else if (["+", "=", "-"].includes(event.key) && item.part === "object") this.#put(item, "scale", part.scale * (event.key === "-" ? 1 / 1.05 : 1.05));
    else if (event.key === "g" && item.part === "object") this.#connection.send("snap", { index: item.index });
    else if (event.key === "d") this.dispatchEvent(new CustomEvent("duplicate", { detail: item.key }));
    else if (event.key === "v") this.#connection.send("show", { part: item.part, index: item.index, on: false });
    else if (event.key === "Delete") this.#connection.send("remove", { part: item.part, index: item.index });
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  /** Change a value here at once, and on the server. */
  #put(item, key, value) {
    const part = this.#part(item);
    if (key === "scale") part.reach *= value / part.scale;
    part[key] = key === "scale" ? Number(value.toPrecision(6)) : rounded(value);
    this.#connection.set(item.part, item.index, key, part[key]);
    this.#place();
    this.dispatchEvent(new CustomEvent("edited", { detail: item.key }));
  }
}

function put(element, at, radius) {
  element.style.display = at ? "" : "none";
  if (!at) return;
  element.setAttribute("cx", at[0] + 0.5);
  element.setAttribute("cy", at[1] + 0.5);
  element.setAttribute("r", radius);
}

function line(element, from, to) {
  element.style.display = from && to ? "" : "none";
  if (!from || !to) return;
  element.setAttribute("x1", from[0] + 0.5);
  element.setAttribute("y1", from[1] + 0.5);
  element.setAttribute("x2", to[0] + 0.5);
  element.setAttribute("y2", to[1] + 0.5);
}

/** Corners of a plane (four) or a box (its base, then its top) in the world; none of a mesh. */
export function proxyCorners({ shape, at, rotate, size }) {
  if (shape === "mesh") return [];
  const [a, b, c] = rotate.map((angle) => (angle * Math.PI) / 180);
  const turned = ([x, y, z]) => {
    [y, z] = [y * Math.cos(a) - z * Math.sin(a), y * Math.sin(a) + z * Math.cos(a)];
    [x, z] = [x * Math.cos(b) + z * Math.sin(b), -x * Math.sin(b) + z * Math.cos(b)];
    [x, y] = [x * Math.cos(c) - y * Math.sin(c), x * Math.sin(c) + y * Math.cos(c)];
    return [x + at[0], y + at[1], z + at[2]];
  };
  const square = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => [(x * size[0]) / 2, (y * size[1]) / 2]);
  const levels = shape === "box" ? [-size[2] / 2, size[2] / 2] : [0];
  return levels.flatMap((z) => square.map(([x, y]) => turned([x, y, z])));
}
