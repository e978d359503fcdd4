// The page: wires the connection, the picture, the handles and the panels together.

import { Capture } from "./capture.js";
import { cameraOf, poseOf, project } from "./geometry.js";
import { Handles } from "./handles.js";
import { Light } from "./light.js";
import { Connection, downloadUrl, dropFile, lightUrl } from "./net.js";
import { QualityPanel, ScenePanel, TimePanel } from "./panels.js";
import { Pointing } from "./pointing.js";
import { SetupPanel } from "./setup.js";
import { View } from "./view.js";

const $ = (id) => document.getElementById(id);
const connection = new Connection();
const view = new View($("canvas"), connection);
const handles = new Handles($("handles"), connection);
const capture = new Capture(connection, $("video"));
const light = new Light($("latlong"), $("ball"), $("light-note"));
const time = new TimePanel(connection);
const scenePanel = new ScenePanel(connection, handles);
const quality = new QualityPanel(connection, time);
const setup = new SetupPanel(connection);
const pointing = new Pointing($("handles"), connection, $("point-note"));
let state = {};
let scene = null;
let camera = null;
let pose = null;
let carded = 0;

// ------------------------------------------------------------------------------------------------------------- messages

let run = null;
connection.addEventListener("hello", ({ detail }) => {
  if (run !== null && run !== detail.run && !$("undo").disabled) notice("The program was restarted: earlier edits are lost.", true);
  run = detail.run;
  $("scene-name").replaceChildren(...detail.scenes.map((name) => new Option(name, name)));
  const group = document.createElement("optgroup");
  group.label = "Another preset";
  group.append(...detail.presets.map((name) => new Option(name, name)));
  const traced = [new Option("Traced", "traced"), new Option("Difference", "difference")];
  $("compare").replaceChildren(new Option("No split", ""), new Option("Camera", "camera"), ...traced, group);
  quality.presets = detail.presets;
  setup.outside = detail.outside;
});

const adopt = (next) => {
  scene = next;
  const { name } = scene;
  if (![...$("scene-name").options].some((option) => option.value === name)) $("scene-name").add(new Option(name, name));
  $("scene-name").value = name;
  document.title = `${name} · warp_ar`;
  handles.scene = scene;
  scenePanel.scene = scene;
  quality.scene = scene;
  setup.scene = scene;
  showHint();
  $("captured-note").hidden = !scene.captured;
  $("captured-note").textContent = scene.captured ? `The light of ${scene.captured} replaces the mirror ball's.` : "";
};
/** Until the first drag, as soon as the picture shows what is to be dragged. */
function showHint() {
  const first = scene?.objects.find((one) => one.visible);
  $("hint").hidden = !first || !view.stats.plan || !!localStorage.getItem("warp_ar.dragged");
  if (first) $("hint").textContent = `The ${(first.file ?? first.shape).replace(/\.\w+$/, "").replaceAll("_", " ")} is not real. Drag it.`;
}
let waiting = null;
// A scene from before this page's last edit would take that edit back on the screen, and the next key or drag would begin there.
const adoptWaiting = () => {
  if (!waiting || handles.busy || !connection.settled) return;
  const next = waiting;
  waiting = null;
  adopt(next);
};
connection.addEventListener("scene", ({ detail }) => {
  showEdit("undo", detail.undo, "Undo", "Ctrl+Z");
  showEdit("redo", detail.redo, "Do again", "Ctrl+Shift+Z");
  waiting = detail.scene;
  adoptWaiting();
});
connection.addEventListener("settled", adoptWaiting);
handles.addEventListener("released", adoptWaiting);
handles.addEventListener("edited", () => {
  $("hint").hidden = true;
  localStorage.setItem("warp_ar.dragged", "1");
});

function showEdit(id, label, verb, keys) {
  // A button that is switched off loses the focus, and the keyboard its place.
  const button = $(id);
  button.title = label ? `${verb}: ${label} (${keys})` : `Nothing to ${verb.toLowerCase()}`;
  button.lastElementChild.textContent = label ? `${verb}: ${label}` : verb;
  if (!label && document.activeElement === button) button.blur();
  button.disabled = !label;
}

connection.addEventListener("setup", ({ detail }) => (setup.message = detail));
connection.addEventListener("plan", ({ detail }) => (time.plan = detail));
connection.addEventListener("budget", ({ detail }) => (quality.budget = detail));

connection.addEventListener("state", ({ detail }) => {
  const before = state;
  state = detail;
  quality.state = state;
  setup.state = state;
  if (before.lens !== state.lens) withdrawOffers(state.lens);
  $("play").setAttribute("aria-pressed", String(state.playing));
  $("play").lastElementChild.textContent = state.playing ? "Hold" : "Go on";
  $("compare").value = state.compare;
  showSplit();
  showBuilding();
  $("use-clip").setAttribute("aria-pressed", String(!state.camera));
  $("use-camera").setAttribute("aria-pressed", String(state.camera));
  $("fps").title = `Frames shown per second; the program lights ${state.fps.toFixed(1)} a second`;
  showCamera();
  showBall(state.ball);
});

/** The ball's light in the bar; its word is short, so that the bar does not move the picture. */
function showBall(found) {
  const [look, words] = { seen: ["tracked", "found"], missing: ["lost", "not seen where the scene has it"], outside: ["held", "out of the picture: its last light stays, as bright as the card"] }[found] ?? ["", "none is looked for"];
  $("ball-state").className = `chip ${look}`;
  $("ball-state").title = `The mirror ball: ${words}`;
}

connection.addEventListener("light", ({ detail }) => light.take(detail));
connection.addEventListener("notice", ({ detail }) => notice(detail.text, detail.bad));
connection.addEventListener("intrinsics", ({ detail }) => {
  const spread = Math.max(1, Math.round(100 * detail.spread));
  offer(`Your camera's focal length was estimated from the marker: ${detail.focal.toFixed(0)} pixels, within about ${spread} %. For exact light, calibrate it.`);
});

connection.addEventListener("calibration", ({ detail }) => {
  const { on, views, wanted, covered, report } = detail;
  if (on) withdrawOffers("calibrating");
  $("calibrate").setAttribute("aria-pressed", String(on));
  $("calibrate").textContent = on ? "Stop" : report ? "Calibrate again" : "Calibrate";
  $("calibrate-finish").hidden = !on || views < 4;
  $("camera-file").hidden = !report;
  $("coverage").hidden = !on;
  $("coverage").style.gridTemplate = `repeat(${covered.length}, 1fr) / repeat(${covered[0]?.length ?? 1}, 1fr)`;
  $("coverage").replaceChildren(...covered.flat().map((seen) => Object.assign(document.createElement("i"), { className: seen ? "on" : "" })));
  const lines = [];
  const fields = covered.flat();
  const [enough, next] = views >= wanted
    ? ["enough", "Press “Use what was seen”, or continue: each further green field makes the result more accurate."]
    : [`${wanted - views} more are good`, "Show the printed card from another side each time, tilted and in all parts of the picture: fields that it reached turn green."];
  if (on) lines.push(`${views} view${views === 1 ? "" : "s"} so far, ${enough}; ${fields.filter(Boolean).length} of ${fields.length} fields reached. ${next}`);
  else if (report) lines.push(`Calibrated and in use: focal length ${report.focal.toFixed(1)} ± ${(2 * report.deviation).toFixed(1)} pixels, ${report.error.toFixed(2)} pixels off on average. Undo takes it back. Start with --calibration camera.yml to have it at once.`, ...report.warnings.map((warning) => `Better: ${warning}.`));
  else lines.push("Print the card, lay it flat and show it to the camera from a dozen sides: then objects and shadows are in the right places.");
  $("calibration-note").textContent = lines.join(" ");
});

// The program loads its libraries before it has anything to say; what is compiled is counted by itself, below the picture.
const starting = setInterval(() => {
  $("veil-words").textContent = `Starting, ${Math.round(performance.now() / 1000)} s: the program loads, then the camera's picture comes, then the lit one.`;
}, 500);
connection.addEventListener("open", () => ($("veil").hidden = view.stats.shown > 0));
connection.addEventListener("lost", ({ detail }) => {
  $("veil").hidden = false;
  showBall("");
  $("track-state").className = "chip";
  $("track-state").lastElementChild.textContent = "not connected";
  clearInterval(starting);
  $("stored").hidden = true;
  $("veil-words").textContent = detail.reason ? `Disconnected: ${detail.reason}` : "The program is not reachable; trying again …";
});

view.addEventListener("shown", ({ detail: frame }) => {
  clearInterval(starting);
  $("veil").hidden = true;
  camera = cameraOf(frame.camera);
  pose = poseOf(frame.pose);
  handles.frame(camera, pose);
  light.pose = pose;
  light.draw();
  time.frame(frame);
  setup.frame(frame);
  showOnCards(frame);
  if (frame.plan && $("hint").hidden) showHint();
  $("track-state").className = `chip ${frame.state ?? ""}`;
  $("track-state").lastElementChild.textContent = frame.state === null ? (frame.plan ? "no marker needed" : "not lit yet") : { tracked: "marker found", held: "marker hidden", lost: "marker not seen" }[frame.state];
});
/** Small pictures of the presets that are lit now: around the first object, every two seconds. */
function showOnCards(frame) {
  const first = scene?.objects.find((one) => one.visible);
  const at = first && pose && project(camera, pose, first.at);
  if (!at || !frame.plan || state.building || performance.now() - carded < 2000) return;
  carded = performance.now();
  const around = [at[0], at[1], Math.max((3.2 * first.reach * camera.fx) / at[2], 48)];
  quality.show(scene.quality, view.pictures[0], around);
  if (view.pictures[1] && state.compare_ready) quality.show(state.compare, view.pictures[1], around);
}
view.addEventListener("resize", () => document.documentElement.style.setProperty("--aspect", $("canvas").width / $("canvas").height));

setInterval(() => {
  const { fps, latency } = view.stats;
  $("fps").textContent = fps ? `${fps.toFixed(1)} fps` : "–";
  $("latency").textContent = latency === null ? "–" : `${latency.toFixed(0)} ms`;
}, 400);

// ------------------------------------------------------------------------------------------------------------- controls

/** A notice that takes the place of the offer before it, and leads to the calibration. */
function offer(text) {
  for (const old of document.querySelectorAll(".notice.offer")) old.remove();
  const box = notice(text);
  box.classList.add("offer");
  // Told before the next state says so.
  box.dataset.lens = text.includes("was estimated") ? "estimated" : "guessed";
  const button = document.createElement("button");
  button.textContent = "Calibrate";
  button.className = "go";
  button.onclick = () => {
    box.remove();
    openTab($("tab-setup"));
    connection.send("calibrate", { step: "start" });
    $("calibrate").scrollIntoView({ block: "nearest" });
    $("calibrate").focus({ preventScroll: true });
  };
  box.lastElementChild.before(button);
}

/** What was offered for another state of the camera is no longer true. */
function withdrawOffers(lens) {
  for (const old of document.querySelectorAll(".notice.offer")) if (old.dataset.lens !== lens) old.remove();
}

function notice(text, bad = false) {
  const holder = $("notices");
  const old = [...holder.children].find((one) => one.dataset.text === text);
  old?.remove();
  const box = document.createElement("div");
  box.className = `notice${bad ? " bad" : ""}`;
  box.dataset.text = text;
  const line = document.createElement("p");
  line.textContent = text;
  const close = document.createElement("button");
  close.textContent = "×";
  close.setAttribute("aria-label", "Close");
  close.onclick = () => box.remove();
  box.append(line, close);
  holder.prepend(box);
  while (holder.children.length > 3) holder.lastElementChild.remove();
  return box;
}

function save(href, name) {
  Object.assign(document.createElement("a"), { href, download: name }).click();
}

/** What is right of the divider; of path tracing, how far it is. */
function rightTag() {
  const { compare, convergence } = state;
  if (compare !== "traced" && compare !== "difference") return state.compare_ready ? compare : `${compare} …`;
  const name = compare === "traced" ? "path tracing" : "difference to path tracing";
  if (state.playing) return `${name}: hold the frame`;
  if (!convergence) return `${name} …`;
  const { samples, error, goal, done, difference } = convergence;
  const noise = samples < 16 ? "too noisy yet to be told apart" : `itself known to ${error.toFixed(1)} %${done ? "" : `, until ${goal.toFixed(1)} %`}`;
  return `${name}: the picture is ${difference.toFixed(2)} % off on average; the reference, ${samples} samples a pixel, is ${noise}`;
}

function showSplit() {
  const on = !!state.compare;
  $("split").hidden = $("divider").hidden = $("tag-left").hidden = $("tag-right").hidden = !on;
  $("divider").style.left = `${100 * view.split}%`;
  $("tag-left").textContent = scene?.quality ?? "";
  $("tag-right").textContent = rightTag();
  $("difference").setAttribute("aria-pressed", String(state.compare === "difference"));
  $("difference-scale").hidden = state.compare !== "difference" || !state.convergence;
  if (state.convergence) $("difference-scale").lastElementChild.textContent = `${state.convergence.scale.toFixed(0)} %`;
  view.draw();
}

let began = 0;
function showBuilding() {
  const { building } = state;
  if ($("building").hidden) began = performance.now();
  $("building").hidden = !building;
  if (!building) return;
  const count = building.count ? ` (${building.done} of ${building.count})` : "";
  const meanwhile = view.stats.plan ? "" : " The camera's picture is shown meanwhile.";
  const [, words, seconds] = $("building").children;
  // Seconds are for the eye alone: a status that is set anew is read out anew.
  const text = `Compiling kernels for ${building.quality}, once for this kind of scene${count}.${meanwhile}`;
  if (words.textContent !== text) words.textContent = text;
  seconds.textContent = `${Math.round((performance.now() - began) / 1000)} s`;
}

function showCamera() {
  if (!camera) return;
  const field = (2 * Math.atan((0.5 * camera.width) / camera.fx) * 180) / Math.PI;
  const guess = state.camera && state.lens === "guessed" ? " Still being estimated: show the marker from several sides." : "";
  $("camera-note").textContent = `${state.source}. ${camera.width}×${camera.height}, focal length ${camera.fx.toFixed(0)} pixels (${field.toFixed(0)}° across).${guess}`;
}

for (const link of document.querySelectorAll("[data-download]")) {
  link.href = downloadUrl(link.dataset.download);
  link.download = link.dataset.download;
}
for (const link of document.querySelectorAll("[data-light]")) link.href = lightUrl;
for (const menu of document.querySelectorAll(".menu")) {
  menu.addEventListener("click", (event) => event.target.closest("a, div > button") && (menu.open = false));
  menu.addEventListener("keydown", (event) => event.key === "Escape" && ((menu.open = false), menu.firstElementChild.focus()));
}
document.addEventListener("pointerdown", (event) => {
  for (const menu of document.querySelectorAll(".menu[open]")) if (!menu.contains(event.target)) menu.open = false;
});
for (const button of document.querySelectorAll("[data-add]")) {
  button.addEventListener("click", () => {
    const [part, kind] = button.dataset.add.split(" ");
    scenePanel.expect(part);
    connection.send("add", { part, kind });
  });
}
for (const button of document.querySelectorAll("[data-point]")) {
  button.addEventListener("click", () => {
    if (!pose) return notice("The marker must be seen before something can be pointed out: show it first.", true);
    pointing.start(button.dataset.point, state.playing);
  });
}
const tabs = [...document.querySelectorAll("[role=tab]")];
const openTab = (tab) => {
  for (const one of tabs) {
    one.setAttribute("aria-selected", String(one === tab));
    one.tabIndex = one === tab ? 0 : -1;
    $(one.getAttribute("aria-controls")).hidden = one !== tab;
  }
  document.querySelector("aside").scrollTop = 0;
};
tabs.forEach((tab, index) => {
  tab.addEventListener("click", () => openTab(tab));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (step) openTab(tabs[(index + step + tabs.length) % tabs.length]), tabs[(index + step + tabs.length) % tabs.length].focus();
  });
});
openTab(tabs[0]);

$("scene-name").addEventListener("change", (event) => connection.send("scene", { name: event.target.value }));
$("difference").addEventListener("click", () => {
  const on = state.compare !== "difference";
  if (on) connection.send("play", { on: false });
  connection.send("compare", { other: on ? "difference" : "" });
});
$("compare").addEventListener("change", (event) => connection.send("compare", { other: event.target.value }));
$("split").addEventListener("input", (event) => {
  view.split = event.target.value / 1000;
  showSplit();
});
$("play").addEventListener("click", () => connection.send("play", { on: !state.playing }));
let recorder = null;
/** Record the picture as it is shown, comparison and all, and save the video when that ends. */
$("record").addEventListener("click", () => {
  if (recorder) return recorder.stop();
  const type = ["video/mp4", "video/webm"].find((one) => window.MediaRecorder?.isTypeSupported(one));
  if (!type) return notice("This browser records no video.", true);
  const parts = [];
  recorder = new MediaRecorder($("canvas").captureStream(), { mimeType: type, videoBitsPerSecond: 1.6e7 });
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.onstop = () => {
    recorder = null;
    showRecording();
    save(URL.createObjectURL(new Blob(parts, { type })), `recording.${type.slice(6)}`);
  };
  recorder.start();
  showRecording();
});
function showRecording() {
  $("record").setAttribute("aria-pressed", String(recorder !== null));
  $("recording-badge").hidden = recorder === null;
}
// A video has one size: it ends where that changes.
view.addEventListener("resize", () => recorder?.stop());
/** Files one after another; what became of each is said in words. */
async function take(files) {
  for (const file of files) {
    const box = notice(`${file.name} is on its way …`);
    if (/\.(glb|gltf|obj|ply|stl|off)$/i.test(file.name)) scenePanel.expect("object");
    const { ok, words } = await dropFile(file);
    if (!ok) scenePanel.expect(null);
    box.remove();
    notice(words, !ok);
  }
}
$("open").addEventListener("click", () => $("open-file").click());
$("open-light").addEventListener("click", () => $("open-file").click());
$("open-file").addEventListener("change", (event) => {
  take([...event.target.files]);
  event.target.value = "";
});
for (const type of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(type, (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return;
    event.preventDefault(); // else the browser leaves the page for the file
    $("figure").classList.toggle("over", type === "dragover");
    if (type === "drop") take([...event.dataTransfer.files]);
  });
}
$("undo").addEventListener("click", () => connection.send("undo"));
$("redo").addEventListener("click", () => connection.send("redo"));
$("guide-go").addEventListener("click", () => {
  openTab($("tab-setup"));
  $("panel-setup").scrollIntoView({ block: "nearest" });
  $("tab-setup").focus({ preventScroll: true });
});
$("reset").addEventListener("click", () => connection.send("reset"));
$("show-handles").addEventListener("click", (event) => {
  const on = event.currentTarget.getAttribute("aria-pressed") !== "true";
  event.currentTarget.setAttribute("aria-pressed", String(on));
  handles.visible = on;
});
$("fullscreen").addEventListener("click", () => (document.fullscreenElement ? document.exitFullscreen() : $("figure").requestFullscreen?.()));
$("use-camera").addEventListener("click", async () => {
  if (capture.on) return;
  try {
    await capture.start();
  } catch (error) {
    const reasons = { NotAllowedError: "the browser was not allowed to open it", NotFoundError: "this device has none", NotReadableError: "another program is using it" };
    notice(`Your camera cannot be opened: ${reasons[error.name] ?? error.message}.`, true);
  }
});
$("use-clip").addEventListener("click", () => capture.stop());
$("calibrate").addEventListener("click", (event) => connection.send("calibrate", { step: event.currentTarget.getAttribute("aria-pressed") === "true" ? "stop" : "start" }));
$("calibrate-finish").addEventListener("click", () => connection.send("calibrate", { step: "finish" }));

document.addEventListener("keydown", (event) => {
  const typing = event.target.closest("select, textarea, input:not([type=range])");
  if ((event.ctrlKey || event.metaKey) && !event.altKey && !typing && ["z", "Z", "y"].includes(event.key)) {
    connection.send(event.key === "y" || event.shiftKey ? "redo" : "undo");
    return event.preventDefault();
  }
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select, textarea, summary")) return;
  const keys = { " ": "play", h: "show-handles", r: "record", f: "fullscreen" };
  if (event.key === " " && event.target.closest("button, [tabindex]:not(g)")) return;
  if (keys[event.key]) $(keys[event.key]).click();
  else if (event.key === "s") save(downloadUrl("frame.png"), "frame.png");
  else if (event.key === "c") connection.send("compare", { other: state.compare ? "" : "camera" });
  else return;
  event.preventDefault();
});

connection.open();
// What the tests read.
window.warpAr = { view, handles, connection, get scene() { return scene; }, get state() { return state; }, get camera() { return camera; }, get pose() { return pose; } };
