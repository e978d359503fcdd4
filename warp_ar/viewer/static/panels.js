// The panels: objects and lights, effects, exposure, quality, time.

import { lightColor, make } from "./handles.js";

export const el = (name, attributes = {}, ...children) => {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && typeof value !== "string") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
};
const svg = (path) => {
  const holder = document.createElement("template");
  holder.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true">${path}</svg>`;
  return holder.content.firstChild;
};
const EYE = '<path d="M2 12s3.6-6.5 10-6.5S22 12 22 12s-3.6 6.5-10 6.5S2 12 2 12z"/><circle cx="12" cy="12" r="2.8"/>';
const SHUT = '<path d="M3 3l18 18M10 6a9 9 0 012-.3c6.400 0 10 6.300 10 6.300a17 17 0 01-3 3.700M6.500 7.500A17 17 0 002 12s3.600 6.500 10 6.500c1.600 0 3-.4 4.300-1"/>';
const BIN = '<path d="M5 7h14M10 7V5h4v2M7 7l1 12h8l1-12"/>';

const toHex = (color) => "#" + color.map((c) => Math.round(255 * Math.pow(Math.min(Math.max(c, 0), 1), 1 / 2.2)).toString(16).padStart(2, "0")).join("");
const fromHex = (hex) => [1, 3, 5].map((i) => Math.round(1e4 * Math.pow(parseInt(hex.slice(i, i + 2), 16) / 255, 2.2)) / 1e4);
const shown = (value) => Math.abs(value) < 5e-4 ? "0" :  (Math.abs(value) >= 100 ? value.toFixed(0) : Math.abs(value) >= 10 ? value.toFixed(1) : value.toFixed(3).replace(/\.?0+$/, "") || "0");

const MM = { unit: "mm", factor: 1000 };
const DEGREES = { unit: "°" };

/**
 * A row of label, slider, number and unit. `curve` above 1 spreads the slider's low end; what is shown is `factor` times
 * the value.
 */
function slider(label, { low, high, curve = 1, step = 0.001, unit = "", factor = 1 }, value, change) {
  const name = unit ? `${label} in ${{ mm: "millimetres", "°": "degrees", "×": "times" }[unit] ?? unit}` : label;
  const range = el("input", { type: "range", min: "0", max: "1000", "aria-label": name });
  const number = el("input", { type: "number", step: String(Number((step * factor).toPrecision(6))), "aria-label": name });
  const place = (v) => {
    range.value = 1000 * Math.pow(Math.min(Math.max((v - low) / (high - low), 0), 1), 1 / curve);
    range.setAttribute("aria-valuetext", `${shown(v * factor)} ${unit}`);
    if (document.activeElement !== number) number.value = shown(v * factor);
  };
  range.addEventListener("input", () => {
    const v = low + (high - low) * Math.pow(range.value / 1000, curve);
    const near = Math.round(v / step) * step;
    range.setAttribute("aria-valuetext", `${shown(near * factor)} ${unit}`);
    if (document.activeElement !== number) number.value = shown(near * factor);
    change(near);
  });
  number.addEventListener("change", () => {
    if (!Number.isFinite(number.valueAsNumber)) return;
    change(number.valueAsNumber / factor);
    place(number.valueAsNumber / factor);
  });
  const row = el("div", { class: "row" }, el("span", {}, label), range, number, el("span", { class: "unit", "aria-hidden": "true" }, unit));
  row.place = place;
  place(value);
  return row;
}

function color(label, value, change) {
  if (!Array.isArray(value)) return el("div", { class: "row" }, el("span", {}, label), el("span", {}, String(value)));
  const input = el("input", { type: "color", "aria-label": label, oninput: () => change(fromHex(input.value)) });
  input.value = toHex(value);
  return el("div", { class: "row" }, el("span", {}, label), input);
}

const shapeName = (proxy) => (proxy.shape === "plane" && proxy.rotate[0] ? "wall" : proxy.shape === "plane" ? "plane" : proxy.file?.replace(/\.\w+$/, "") ?? proxy.shape);

const LISTS = { object: "objects", light: "lights", proxy: "proxies" };
const MODELS = { metallic_roughness: "Metallic-roughness", phong: "Phong", lambert: "Chalk", mirror: "Mirror", emissive: "Emits", file: "The file's own" };
const EFFECTS = {
  objects: ["Virtual objects", ""],
  lights: ["Virtual lights", ""],
  environment: ["Environment", "light captured from the mirror ball"],
  receiver: ["Shape of the desk", "receives light and shadow, hides what is behind it"],
  environment_shadow: ["Shadows of the environment", "under virtual objects"],
  relief: ["Reflectance of the desk", "virtual light takes on its colours and patterns"],
  exposure: ["Exposure", "darkens as a camera would"],
};

export class ScenePanel {
  #connection;
  #handles;
  #scene = null;
  #selected = null;
  #shape = "";
  #expected = null;

  constructor(connection, handles) {
    this.#connection = connection;
    this.#handles = handles;
    this.parts = document.getElementById("parts");
    this.inspector = document.getElementById("inspector");
    this.proxies = document.getElementById("proxies");
    this.proxyInspector = document.getElementById("proxy-inspector");
    handles.addEventListener("select", ({ detail }) => this.select(detail, false));
    handles.addEventListener("edited", ({ detail }) => detail === this.#selected && this.#inspect());
    handles.addEventListener("duplicate", ({ detail }) => this.#duplicate(detail));
  }

  /** Choose the part of a kind that comes next; null: none any more. */
  expect(part) {
    this.#expected = part && { part, count: this.#scene[LISTS[part]].length };
  }

  #duplicate(key) {
    const [part, index] = key.split(" ");
    this.expect(part);
    this.#connection.send("duplicate", { part, index: Number(index) });
  }

  select(key, tellHandles = true) {
    this.#selected = key;
    if (tellHandles) this.#handles.selected = key;
    this.#mark();
    this.#inspect();
  }

  #mark() {
    for (const item of [...this.parts.children, ...this.proxies.children]) {
      item.classList.toggle("on", item.dataset.key === this.#selected);
      item.querySelector(".pick")?.setAttribute("aria-current", String(item.dataset.key === this.#selected));
    }
  }

  set scene(scene) {
    this.#scene = scene;
    const focused = document.activeElement?.closest?.("[data-key] > button");
    const back = focused && [focused.closest("[data-key]").dataset.key, focused.className];
    const entries = [...scene.objects.map((o, i) => ["object", i, o]), ...scene.lights.map((l, i) => ["light", i, l])];
    this.parts.replaceChildren(...entries.map(([part, index, item]) => this.#entry(part, index, item)));
    if (!entries.length) this.parts.append(el("li", { class: "note" }, "Nothing yet: add an object or a light."));
    this.proxies.replaceChildren(...scene.proxies.map((proxy, index) => this.#entry("proxy", index, proxy)));
    const { part, count } = this.#expected ?? {};
    if (part && scene[LISTS[part]].length > count) {
      this.#expected = null;
      this.#selected = `${part} ${scene[LISTS[part]].length - 1}`;
      this.#handles.selected = this.#selected;
    }
    const known = (key) => document.querySelector(`:is(#parts, #proxies) [data-key="${key}"]`);
    if (!this.#selected || !known(this.#selected)) {
      this.#selected = entries.length ? `${entries[0][0]} ${entries[0][1]}` : null;
      this.#handles.selected = this.#selected;
    }
    this.#mark();
    // The list is made anew: whoever was at one of its buttons stays there.
    if (back) (known(back[0])?.querySelector(`.${back[1]}`) ?? this.parts.querySelector(".pick"))?.focus({ preventScroll: true });
    const inside = this.inspector.contains(document.activeElement) || this.proxyInspector.contains(document.activeElement);
    const shape = JSON.stringify([scene.name, this.#selected, this.#item() && Object.keys(this.#item()), this.#item()?.material?.model, this.#item()?.target === null]);
    if (shape !== this.#shape || !inside) this.#inspect();
    this.#shape = shape;
    this.#effects(scene);
    this.#exposure(scene);
  }

  #entry(part, index, item) {
    const key = `${part} ${index}`;
    const tint = part === "light" ? item.color : part === "proxy" ? null : item.material.base_color ?? item.material.diffuse ?? item.material.color;
    const dot = el("i", { class: part });
    const css = Array.isArray(tint) ? (part === "light" ? lightColor(tint) : toHex(tint)) : "#999";
    dot.style.background = css;
    dot.style.setProperty("--c", css);
    const name = part === "proxy" ? shapeName(item) : part === "light" ? { point: "Point light", spot: "Spotlight", directional: "Sun" }[item.kind] : item.file?.replace(/\.\w+$/, "") ?? item.shape;
    const title = name[0].toUpperCase() + name.slice(1);
    const entry = el("li", { class: item.visible ? "" : "off" },
      el("button", { class: "pick", onclick: () => this.select(key) }, dot, title),
      el("button", { class: "eye", "aria-label": `${item.visible ? "Hide" : "Show"} ${title}`, title: item.visible ? "Hide" : "Show",
        onclick: () => this.#connection.send("show", { part, index, on: !item.visible }) }, svg(item.visible ? EYE : SHUT)),
      el("button", { class: "drop", "aria-label": `Remove ${title}`, title: "Remove", onclick: () => this.#connection.send("remove", { part, index }) }, svg(BIN)));
    entry.dataset.key = key;
    return entry;
  }

  #item() {
    if (!this.#selected || !this.#scene) return null;
    const [part, index] = this.#selected.split(" ");
    return this.#scene[LISTS[part]][index] ?? null;
  }

  #inspect() {
    const item = this.#item();
    // What was chosen before stays, out of use: the panel keeps its place.
    this.inspector.inert = this.proxyInspector.inert = !item;
    if (!item) return;
    this.inspector.replaceChildren();
    this.proxyInspector.replaceChildren();
    const [part, number] = this.#selected.split(" ");
    const index = Number(number);
    const set = (key, value, holder = item) => {
      holder[key] = value;
      this.#connection.set(part, index, key, value);
      if (holder === item) this.#handles.scene = this.#scene;
    };
    const along = (key, axis) => (value) => {
      const changed = [...item[key]];
      changed[axis] = value;
      set(key, changed);
    };
    const rows = [];
    if (part === "proxy") return this.proxyInspector.replaceChildren(...this.#proxy(item, along));
    if (item.kind !== "directional") {
      rows.push(slider("Height", { low: part === "light" ? 0.01 : 0, high: part === "light" ? 1 : 0.3, curve: 1.6, ...MM }, item.at[2], along("at", 2)));
    }
    if (part === "object") rows.push(...this.#object(item, set, along));
    else rows.push(...this.#light(item, set));
    const actions = [el("button", { title: "d", onclick: () => this.#duplicate(this.#selected) }, "Duplicate")];
    if (part === "object") actions.push(el("button", { title: "g", onclick: () => this.#connection.send("snap", { index }) }, "Set on the desk"));
    this.inspector.replaceChildren(...rows, el("div", { class: "actions" }, ...actions));
  }

  /** Sizes and place of a shape of the desk. */
  #proxy(item, along) {
    const sides = item.shape === "box" ? ["Width", "Depth", "Height"] : item.rotate[0] ? ["Width", "Height"] : ["Width", "Depth"];
    const sizes = item.size.map((size, axis) => slider(sides[axis], { low: 0.005, high: Math.max(0.6, 1.5 * size), curve: 2, ...MM }, size, along("size", axis)));
    const places = ["Right", "Away", "Up"].map((label, axis) => slider(label, { low: axis < 2 ? -0.8 : 0, high: axis < 2 ? 0.8 : 0.4, ...MM }, item.at[axis], along("at", axis)));
    return [...places, ...sizes, slider("Turn", { low: -180, high: 180, step: 1, ...DEGREES }, ((item.rotate[2] + 540) % 360) - 180, along("rotate", 2))];
  }

  #object(item, set, along) {
    const { material } = item;
    const rows = [slider("Turn", { low: -180, high: 180, step: 1, ...DEGREES }, ((item.rotate[2] + 540) % 360) - 180, along("rotate", 2))];
    const scale = item.scale;
    // A size that can be held against a ruler: twice the reach, which grows with the scale.
    const across = (2000 * item.reach) / scale;
    rows.push(slider("Size", { low: scale * 0.25, high: scale * 2.5, step: scale / 200, unit: "mm", factor: across }, scale, (value) => set("scale", value)));
    const model = el("select", { "aria-label": "Material", onchange: () => set("model", model.value, {}) },
      ...Object.entries(MODELS).map(([value, text]) => el("option", { value, selected: value === material.model }, text)));
    rows.push(el("div", { class: "row" }, el("span", {}, "Material"), model));
    const number = (label, key, limits) => key in material && rows.push(slider(label, limits, material[key], (value) => set(key, value, material)));
    for (const [label, key] of [["Colour", "base_color"], ["Diffuse", "diffuse"], ["Specular", "specular"], ["Light", "color"]]) {
      if (key in material) rows.push(color(label, material[key], (value) => set(key, value, material)));
    }
    number("Metallic", "metallic", { low: 0, high: 1, step: 0.01 });
    number("Roughness", "roughness", { low: 0, high: 1, step: 0.01 });
    number("Shininess", "shininess", { low: 0, high: 1000, curve: 3, step: 1 });
    // Of what emits: 1 is what the camera clips.
    number("Emission", "intensity", { low: 0, high: Math.max(20, material.intensity ?? 0), curve: 3, step: 0.01 });
    if (item.animations) rows.push(...this.#animation(item, Number(this.#selected.split(" ")[1])));
    return rows;
  }

  /** Which of the file's animations an object plays, and how; the server keeps its pose where it is. */
  #animation(item, index) {
    const tell = (key, value) => {
      item[key] = value;
      this.#connection.send("animate", { index, key, value: Number(value) });
    };
    const speed = slider("Speed", { low: 0.05, high: 4, curve: 2, step: 0.05, unit: "×" }, item.speed, (value) => tell("speed", Math.max(value, 0.01)));
    const flip = el("button", { class: "switch", role: "switch", id: "animation-loop", "aria-checked": String(item.loop), "aria-label": "Loop",
      onclick: () => { tell("loop", !item.loop); flip.setAttribute("aria-checked", String(item.loop)); } });
    const pause = el("button", { type: "button", id: "animation-pause", onclick: () => { tell("paused", !item.paused); show(); } });
    const show = () => {
      const still = item.animation < 0;
      for (const control of [pause, flip, ...speed.querySelectorAll("input")]) control.disabled = still;
      pause.textContent = item.paused || still ? "Play" : "Pause";
    };
    const pick = el("select", { "aria-label": "Animation", onchange: () => { item.paused = false; tell("animation", Number(pick.value)); show(); } },
      ...["None", ...item.animations].map((text, k) => el("option", { value: String(k - 1), selected: k - 1 === item.animation }, text)));
    show();
    return [el("div", { class: "row" }, el("span", {}, "Animation"), pick, pause), speed,
      el("label", { class: "toggle", for: "animation-loop" }, el("span", {}, "Loop"), flip)];
  }

  #light(item, set) {
    const rows = [color("Colour", item.color, (value) => set("color", value))];
    const high = item.kind === "spot" ? 12 : item.kind === "point" ? 3 : 6;
    rows.push(slider("Intensity", { low: 0, high: Math.max(high, item.intensity), curve: 2, step: 0.005 }, item.intensity, (value) => set("intensity", value)));
    if (item.kind === "spot") {
      rows.push(slider("Inner cone", { low: 0, high: 60, step: 0.5, ...DEGREES }, item.inner_angle, (v) => set("inner_angle", Math.min(v, item.outer_angle))));
      rows.push(slider("Outer cone", { low: 1, high: 80, step: 0.5, ...DEGREES }, item.outer_angle, (v) => set("outer_angle", Math.max(v, item.inner_angle))));
    }
    if (item.kind !== "directional") rows.push(slider("Softness", { low: 0, high: 0.1, curve: 2, ...MM }, item.radius, (value) => set("radius", value)));
    return rows;
  }

  #effects(scene) {
    const holder = document.getElementById("effects");
    const focused = document.activeElement?.id;
    holder.replaceChildren(...Object.entries(scene.effects).map(([name, on]) => {
      const [title, about] = EFFECTS[name] ?? [name, ""];
      const flip = el("button", { class: "switch", role: "switch", id: `effect-${name}`, "aria-checked": String(on), "aria-label": title,
        onclick: () => this.#connection.send("effect", { name, on: flip.getAttribute("aria-checked") !== "true" }) });
      const label = el("label", { class: "toggle", for: flip.id }, el("span", {}, title, about ? el("small", {}, about) : ""), flip);
      return label;
    }));
    if (focused?.startsWith("effect-")) document.getElementById(focused)?.focus();
  }

  #exposure(scene) {
    const holder = document.getElementById("exposure");
    if (holder.contains(document.activeElement) && document.activeElement.type === "range" && scene.exposure !== "auto") return;
    const auto = scene.exposure === "auto";
    const set = (value) => this.#connection.set("exposure", 0, "scale", value);
    const row = slider("Scale", { low: 0, high: 2, step: 0.01, unit: "×" }, auto ? 1 : scene.exposure, set);
    row.querySelectorAll("input").forEach((input) => (input.disabled = auto));
    const flip = el("button", { class: "switch", role: "switch", id: "exposure-auto", "aria-checked": String(auto), "aria-label": "Automatic exposure",
      onclick: () => set(auto ? 1 : "auto") });
    holder.replaceChildren(row, el("label", { class: "toggle", for: "exposure-auto" }, el("span", {}, "Automatic", el("small", {}, "keeps highlights below clipping")), flip));
  }
}

const spoken = (name) => name.replaceAll("_", " ");
const hue = (index) => `hsl(${(28 + index * 47) % 360} ${58 + (index % 3) * 9}% ${56 + (index % 2) * 8}%)`;
const HISTORY = 120;

export class TimePanel {
  #connection;
  #plan = null;
  #means = new Map();
  #skips = new Map();
  #frames = [];
  #rows = new Map();
  #painted = 0;
  budget = null;

  constructor(connection) {
    this.#connection = connection;
    this.list = document.getElementById("stages");
    this.canvas = document.getElementById("history");
    this.total = document.getElementById("frame-ms");
  }

  set plan(plan) {
    this.#plan = plan;
    this.#means.clear();
    this.#skips.clear();
    this.#rows.clear();
    const all = [...plan.run, { stage: "encode", method: "", methods: [], summary: "packs the picture for the page, once for all viewers" }];
    const runs = all.map((entry, index) => this.#row(entry, hue(index)));
    const outs = plan.left_out.map((entry) => this.#row(entry, "var(--line)"));
    this.list.replaceChildren(...runs, ...outs);
    const several = plan.run.filter((entry) => entry.methods.length > 1).concat(plan.left_out.filter((entry) => entry.methods.length > 1));
    document.getElementById("methods").replaceChildren(...several.map((entry) => this.#methodsOf(entry)));
  }

  #methodsOf({ stage, method, methods }) {
    const pick = el("select", { "aria-label": `Method of ${spoken(stage)}`, onchange: () => this.#connection.send("method", { stage, method: pick.value }) },
      ...(methods.includes(method) ? [] : [el("option", { value: "", selected: true }, "default")]),
      ...methods.map((one) => el("option", { value: one, selected: one === method }, spoken(one))));
    return el("div", { class: "row typed" }, el("span", {}, spoken(stage)), pick);
  }

  #row(entry, tint) {
    const out = "reason" in entry;
    const why = el("div", { class: "why" }, out ? `Left out: ${entry.reason}.` : `${entry.summary[0].toUpperCase()}${entry.summary.slice(1)}.`);
    const bar = el("b");
    const time = el("span", { class: "ms" }, out ? "–" : "");
    const row = el("li", { class: out ? "out" : "", tabindex: "0", title: why.firstChild.textContent },
      el("span", { class: "name" }, el("i"), spoken(entry.stage)), out ? el("span", { class: "ms" }, "left out") : el("span", { class: "bar" }, bar), time, why);
    row.style.setProperty("--c", tint);
    row.dataset.stage = entry.stage;
    this.#rows.set(entry.stage, { row, bar, time, tint, why, out, summary: entry.summary });
    return row;
  }

  frame(frame) {
    if (!frame.plan || frame.plan !== this.#plan?.plan) return;
    const stages = [...frame.stages, ["encode", frame.encode_ms, false]];
    for (const [name, ms, skipped] of stages) {
      const mean = this.#means.get(name);
      // A mean over the frames in which a stage ran; being skipped is told apart.
      if (!skipped) this.#means.set(name, mean === undefined ? ms : mean + (ms - mean) * 0.12);
      this.#skips.set(name, (this.#skips.get(name) ?? 0) * 0.9 + (skipped ? 0.1 : 0));
    }
    this.#frames.push({ stages, total: frame.light_ms });
    if (this.#frames.length > HISTORY) this.#frames.shift();
    const now = performance.now();
    if (now - this.#painted < 120 || !this.canvas.offsetParent) return;
    this.#painted = now;
    this.#paint(frame);
  }

  #paint(frame) {
    const longest = Math.max(...this.#means.values(), 0.1);
    const skipped = new Set(frame.stages.filter((stage) => stage[2]).map((stage) => stage[0]));
    for (const [name, { row, bar, time, why, out, summary }] of this.#rows) {
      if (out) continue;
      const ms = this.#means.get(name);
      const rests = skipped.has(name) && this.#skips.get(name) > 0.6;
      row.classList.toggle("skipped", rests);
      bar.style.width = ms === undefined || rests ? "0" : `${Math.max(1, (100 * ms) / longest)}%`;
      time.textContent = rests ? "skipped" : ms === undefined ? "" : ms.toFixed(ms < 10 ? 2 : 1);
      const text = rests ? "Skipped: its inputs have not changed." : `${summary[0].toUpperCase()}${summary.slice(1)}.`;
      if (why.firstChild.textContent !== text) {
        why.firstChild.textContent = text;
        row.title = text;
      }
    }
    const totals = this.#frames.map((f) => f.total).sort((a, b) => a - b);
    this.total.textContent = `${totals[totals.length >> 1].toFixed(1)} ms a frame`;
    const { canvas } = this;
    const scale = devicePixelRatio || 1;
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    const top = Math.max(totals[Math.floor(totals.length * 0.95)] * 1.25, this.budget ?? 0, 8);
    const column = width / HISTORY;
    this.#frames.forEach((f, i) => {
      let y = height;
      for (const [name, ms] of f.stages) {
        const h = (ms / top) * height;
        context.fillStyle = this.#rows.get(name)?.tint ?? "#888";
        context.fillRect(width - (this.#frames.length - i) * column, y - h, Math.max(column - 0.5, 1), h);
        y -= h;
      }
    });
    context.font = `${11 * scale}px system-ui`;
    for (const [ms, style] of [[1000 / 30, "#8888"], ...(this.budget ? [[this.budget, "#f0a63c"]] : [])]) {
      const y = height - (ms / top) * height;
      if (y < 4) continue;
      context.fillStyle = style;
      context.fillRect(0, y, width, scale);
      // The budget is written on the right, where it does not cover the other.
      const own = ms === this.budget;
      context.textAlign = own ? "right" : "left";
      context.fillText(`${ms.toFixed(0)} ms`, own ? width - 4 * scale : 4 * scale, y - 3 * scale);
    }
  }
}

const BUDGET = { low: 1, high: 1000 }; // milliseconds
const AIM = 0.9; // the share of a budget that the program plans for
const share = (ms) => Math.min(Math.max(Math.log(Math.max(ms, BUDGET.low) / BUDGET.low) / Math.log(BUDGET.high / BUDGET.low), 0), 1);
const duration = (seconds) => (seconds < 90 ? `${Math.max(Math.round(seconds / 5) * 5, 5)} s` : `${Math.round(seconds / 60)} minutes`);
const brief = (ms) => ms.toFixed(ms < 10 ? 1 : 0);
const shape = (name, attributes, text = "") => Object.assign(make(name, attributes), { textContent: text });

export class QualityPanel {
  #connection;
  #time;
  #state = null;
  #budget = null;
  #cards = new Map();
  #later = 0;

  constructor(connection, time) {
    this.#connection = connection;
    this.#time = time;
    this.holder = document.getElementById("presets");
    this.range = document.getElementById("budget");
    this.flip = document.getElementById("budget-on");
    this.plot = document.getElementById("frontier");
    this.range.addEventListener("input", () => {
      this.flip.setAttribute("aria-checked", "true");
      this.#draw();
      // What the budget buys is known here at once; the picture follows when the hand rests.
      clearTimeout(this.#later);
      this.#later = setTimeout(() => this.#tell(), 150);
    });
    this.flip.addEventListener("click", () => {
      this.flip.setAttribute("aria-checked", String(!this.#on));
      this.#tell();
      this.#draw();
    });
    new ResizeObserver(() => this.#draw()).observe(this.plot);
  }

  get #ms() {
    return BUDGET.low * Math.pow(BUDGET.high / BUDGET.low, this.range.value / 1000);
  }

  get #on() {
    return this.flip.getAttribute("aria-checked") === "true";
  }

  #tell() {
    this.#later = 0;
    this.#connection.send("budget", { ms: this.#on ? Math.round(this.#ms * 10) / 10 : null });
  }

  set presets(names) {
    this.#cards = new Map(names.map((name) => [name, this.#card(name)]));
    this.holder.replaceChildren(...[...this.#cards.values()].map(({ card }) => card));
    const buttons = [...this.#cards.values()].map(({ button }) => button);
    this.holder.onkeydown = (event) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      const place = buttons.indexOf(document.activeElement);
      if (!step || place < 0) return;
      event.preventDefault();
      buttons[(place + step + buttons.length) % buttons.length].focus();
    };
  }

  #card(name) {
    const picture = el("canvas", { width: 96, height: 72, "aria-hidden": "true" });
    // Of the bundled desk, until this machine has a picture of its own.
    const image = new Image();
    image.onload = () => picture.dataset.own || picture.getContext("2d").drawImage(image, 0, 0, picture.width, picture.height);
    image.src = `static/preset-${name}.jpg`;
    const [cost, off] = [el("small"), el("small")];
    const button = el("button", { role: "radio", "data-preset": name, "aria-checked": "false", onclick: () => this.#connection.send("quality", { name }) },
      picture, el("b", {}, name), cost, off);
    const compare = el("button", { class: "beside", "aria-pressed": "false", title: `Show ${name} beside what is shown now`, "aria-label": `Compare with ${name}`,
      onclick: () => this.#connection.send("compare", { other: this.#state?.compare === name ? "" : name }) }, "Compare");
    return { card: el("div", { class: "card" }, button, compare), button, compare, picture, cost, off };
  }

  /** Take a preset's small picture from one that it has lit: the surroundings of a pixel. */
  show(name, picture, [x, y, size]) {
    const own = this.#cards.get(name)?.picture;
    if (!own?.offsetParent) return;
    own.dataset.own = "1";
    own.getContext("2d").drawImage(picture, x - (size * 2) / 3, y - size / 2, (size * 4) / 3, size, 0, 0, own.width, own.height);
  }

  set scene(scene) {
    for (const [name, { button }] of this.#cards) button.setAttribute("aria-checked", String(name === scene.quality));
  }

  set budget(budget) {
    this.#budget = budget;
    this.#draw();
  }

  set state(state) {
    this.#state = state;
    if (!this.#later && !this.range.matches(":active")) {
      this.flip.setAttribute("aria-checked", String(state.budget !== null));
      if (state.budget !== null && document.activeElement !== this.range) this.range.value = 1000 * share(state.budget);
    }
    for (const [name, { compare, cost, off }] of this.#cards) {
      const [known, error] = [state.costs[name], this.#budget?.errors[name]];
      cost.textContent = known ? `${known.frames ? "" : "about "}${brief(known.ms)} ms · ${(1000 / known.ms).toFixed(known.ms > 100 ? 1 : 0)} fps` : "takes seconds a frame";
      off.textContent = error === undefined ? "the most exact" : `${inWords(error)} · ${error.toFixed(3)}`;
      compare.setAttribute("aria-pressed", String(state.compare === name));
    }
    this.#draw();
  }

  /** Times here over those that methods were measured to take, from the base, which is medium. */
  get #load() {
    const { costs = {}, load } = this.#state ?? {};
    return load ?? (costs.medium ? costs.medium.ms / this.#budget.base : 1);
  }

  /** What the slider's budget buys, as the program chooses; null while no costs are known. */
  #bought() {
    const { base, choices } = this.#budget ?? {};
    if (!choices) return null;
    const factor = this.#load;
    const took = (choice) => factor * (base + choice.ms);
    const fitting = choices.filter((choice) => took(choice) <= AIM * this.#ms);
    const choice = fitting.at(-1) ?? choices[0];
    return { choice, took, fits: fitting.length > 0 };
  }

  #draw() {
    const on = this.#on;
    this.#time.budget = on ? this.#ms : null;
    document.getElementById("budget-value").textContent = on ? `${brief(this.#ms)} ms · ${(1000 / this.#ms).toFixed(0)} fps` : "off";
    this.range.setAttribute("aria-valuetext", `${brief(this.#ms)} milliseconds`);
    if (!this.plot.parentElement.offsetParent) return;
    const bought = this.#bought();
    this.plot.parentElement.classList.toggle("off", !on);
    this.#plot(bought);
    document.getElementById("buys").replaceChildren(...(this.#budget?.known && on ? this.#methods(bought.choice) : []));
    document.getElementById("budget-note").textContent = this.#note(bought);
  }

  #note(bought) {
    const { measuring, remaining } = this.#budget ?? {};
    if (typeof measuring === "number") {
      const left = remaining === null || remaining === undefined ? "" : `, about ${duration(remaining)} left`;
      return `Measuring the cost of each method on this device, once: ${Math.round(100 * measuring)} %${left}. The picture is slower meanwhile.`;
    }
    if (!bought) return "The program then chooses the methods with the smallest error within this time. Their costs on this device are measured once; the remaining time is shown as soon as it is known.";
    const { choice, took, fits } = bought;
    if (this.#budget.choices.every((one) => one.error === 0)) return "The errors of these methods are not in the cost table, so the cheapest are used: python -m warp_ar.tradeoff makes a table.";
    const parts = [`${this.#on ? "This buys" : "This would buy"} about ${brief(took(choice))} ms a frame, with an error of ${error(choice.error)} against the truth.`];
    if (!fits) parts.push("Nothing cheaper is left.");
    return parts.join(" ");
  }

  /** Error over time, over the slider's own scale: presets, hollow until they ran here, and what can be bought, as far as it is known. */
  #plot(bought) {
    const { choices = [], errors = {}, known } = this.#budget ?? {};
    const { costs = {} } = this.#state ?? {};
    const presets = Object.entries(errors).filter(([name]) => costs[name]).map(([name, error]) => ({ name, error, ...costs[name] }));
    const [width, height] = [this.plot.clientWidth, this.plot.clientHeight];
    const [left, right, top, bottom] = [34, 8, 16, 4];
    const x = (ms) => left + share(ms) * (width - left - right);
    const most = Math.max(...choices.map((c) => c.error), ...presets.map((p) => p.error), 0.1);
    const y = (e) => top + (1 - e / most) * (height - top - bottom);
    const placed = [];
    const label = (name, px, py) => {
      const before = px > width - 50; // no room behind it
      const at = [before ? px - 52 : px + 6, Math.max(py - 5, 10)];
      while (placed.some(([ox, oy]) => Math.abs(at[0] - ox) < 44 && Math.abs(at[1] - oy) < 11)) at[1] += 11;
      placed.push(at);
      return shape("text", { x: before ? px - 8 : at[0], y: at[1], class: before ? "tick" : "" }, name);
    };
    const parts = [shape("text", { x: 0, y: 9 }, "error, FLIP")];
    for (let e = 0; e <= most; e += 0.1) {
      parts.push(shape("line", { class: "grid", x1: left, x2: width - right, y1: y(e), y2: y(e) }), shape("text", { class: "tick", x: left - 6, y: y(e) + (e ? 4 : 0) }, e ? e.toFixed(1) : "0"));
    }
    for (const ms of [1, 10, 100, 1000]) parts.push(shape("line", { class: "grid", x1: x(ms), x2: x(ms), y1: top, y2: height }));
    if (bought) {
      const { choice, took } = bought;
      let path = "";
      for (const c of choices) path += path ? `H${x(took(c)).toFixed(1)}V${y(c.error).toFixed(1)}` : `M${x(took(c)).toFixed(1)} ${top}V${y(c.error).toFixed(1)}`;
      parts.push(shape("path", { class: "area", d: `${path}H${width - right}V${height}H${x(took(choices[0])).toFixed(1)}Z` }), shape("path", { class: "line", d: `${path}H${width - right}` }));
      if (known) parts.push(shape("circle", { class: "choice", cx: x(took(choice)), cy: y(choice.error), r: 5 }));
    }
    if (this.#on) parts.push(shape("line", { class: "budget", x1: x(this.#ms), x2: x(this.#ms), y1: 4, y2: height }));
    for (const { name, error, ms, frames } of presets) {
      parts.push(shape("circle", { class: `preset${frames ? "" : " about"}`, cx: x(ms), cy: y(error), r: 3.5 }), label(name, x(ms), y(error)));
    }
    this.plot.replaceChildren(...parts);
    this.plot.setAttribute("aria-label", `Error over time. ${presets.map(({ name, error, ms }) => `${name}: ${brief(ms)} milliseconds, error ${error.toFixed(3)}`).join("; ")}`);
  }

  #methods(choice) {
    return Object.entries(this.#budget.settings).map(([name, methods], index) => {
      const place = choice.methods[index];
      const pips = el("span", { class: "pips", "aria-hidden": "true" }, ...methods.map((_, i) => el("i", { class: i <= place ? "on" : "" })));
      return el("li", {}, el("span", { class: "name" }, spoken(name)), pips, el("span", {}, spoken(methods[place])));
    });
  }
}

const error = (value) => `${value.toFixed(3)} FLIP`;
const inWords = (value) => (value < 0.05 ? "hardly to be told from the truth" : value < 0.13 ? "close to the truth" : value < 0.2 ? "visibly off" : "plainly off");
