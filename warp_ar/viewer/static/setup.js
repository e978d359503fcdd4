// Setting up one's own desk: the card, its sizes, what is missing, the measurements, and what is wrong.

import { codeUrl } from "./net.js";
import { el } from "./panels.js";

const $ = (id) => document.getElementById(id);
const DICTIONARIES = ["DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_5X5_50", "DICT_5X5_100", "DICT_5X5_250", "DICT_6X6_50", "DICT_6X6_250", "DICT_7X7_50", "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11"];
const family = (name) => name.replace(/^DICT_/, "");
const millimetres = (metres) => Number((1000 * metres).toFixed(2));

export class SetupPanel {
  #connection;
  #scene = null;
  #state = {};
  #frame = null;
  #clock = null;
  #busy = null;
  #began = 0;

  constructor(connection) {
    this.#connection = connection;
    $("use-card").addEventListener("click", () => {
      const [radius, ruler] = [$("ball-radius"), $("ruler")].map((input) => input.valueAsNumber / 1000);
      if (Number.isFinite(radius) && Number.isFinite(ruler)) connection.send("card", { radius, ruler });
    });
    $("use-marker").addEventListener("click", () => {
      connection.set("marker", 0, "dictionary", $("marker-dictionary").value);
      if (Number.isInteger($("marker-id").valueAsNumber)) connection.set("marker", 0, "id", $("marker-id").valueAsNumber);
      if (Number.isFinite($("marker-size").valueAsNumber)) connection.set("marker", 0, "size", $("marker-size").valueAsNumber / 1000);
    });
    $("measure-ball").addEventListener("click", () => connection.send("setup", { step: "ball" }));
    $("card-light").addEventListener("click", () => connection.send("setup", { step: "light" }));
    $("measure-response").addEventListener("click", () => connection.send("setup", { step: "response" }));
    $("check").addEventListener("click", () => connection.send("setup", { step: "check" }));
    $("marker-dictionary").replaceChildren(...DICTIONARIES.map((name) => el("option", { value: name }, family(name))));
  }

  set scene(scene) {
    const before = JSON.stringify([this.#scene?.marker, this.#scene?.probes]);
    this.#scene = scene;
    const { marker, probes } = scene;
    const own = marker.board === null;
    const size = (metres) => `${millimetres(metres)} mm`;
    $("marker-note").textContent = marker.ruler !== null
      ? `The scene uses the printed card${Math.abs(marker.ruler - 0.1) > 1e-6 ? `, whose rulers are ${size(marker.ruler)}` : ""}${probes.length ? `; the ball's radius is ${size(probes[0].radius)}` : ""}.`
      : own
        ? `The scene expects another marker: number ${marker.id} of the family ${family(marker.dictionary)}, ${size(marker.size)} wide.`
        : `The scene expects a board of its own: ${marker.board}.`;
    // What is typed stays until the scene says otherwise.
    if (before === JSON.stringify([marker, probes])) return;
    if (probes.length) $("ball-radius").value = millimetres(probes[0].radius);
    $("ruler").value = millimetres(marker.ruler ?? 0.1);
    if (!DICTIONARIES.includes(marker.dictionary)) $("marker-dictionary").append(el("option", { value: marker.dictionary }, family(marker.dictionary)));
    $("marker-dictionary").value = marker.dictionary;
    $("marker-id").value = marker.id;
    $("marker-size").value = millimetres(marker.size);
    this.#say();
  }

  /** Address for other machines, with its code for a phone's camera; null where they do not reach this page. */
  set outside(address) {
    $("phone").hidden = !address;
    $("phone-note").textContent = address ? `Point a phone's camera at the code, or open ${address} there.` : "To open this page on a phone, start the program with --host 0.0.0.0 --tls.";
    if (address) $("phone").src = codeUrl;
  }

  set state(state) {
    this.#state = state;
    this.#say();
  }

  frame(frame) {
    if (this.#frame?.state === frame.state && !!this.#frame?.plan === !!frame.plan) return;
    this.#frame = frame;
    this.#say();
  }

  /** What is seen, or what is missing and what to do. */
  #say() {
    const { missing, camera } = this.#state;
    const seen = this.#frame?.state;
    const what = this.#scene?.marker.board ? "the whole card" : "the whole black square of the marker";
    const words = missing
      ? `${sentence(missing.text)} ${remedy(missing)}`
      : seen === "tracked"
        ? "The marker is seen. Continue with the camera."
        : seen
          ? `The marker is not seen: ${what}, with the white around it, must be in the picture, flat, sharp and lit.`
          : camera
            ? "The camera's picture is not lit yet."
            : "This is the scene's own clip: press “My camera” to show your desk.";
    put("seen-note", words);
    $("guide").hidden = !(missing || (camera && seen && seen !== "tracked"));
    put("guide", words, true);
    const guessed = this.#state.lens === "guessed" ? "Guessed so far: the camera’s field of view" : this.#state.lens === "estimated" ? "Estimated: the camera’s focal length" : "";
    $("guess").hidden = !guessed;
    put("guess", guessed);
  }

  set message({ busy, doing, findings, outdated, measured, failed }) {
    for (const id of ["measure-ball", "card-light", "measure-response", "check"]) $(id).disabled = busy !== null;
    clearInterval(this.#clock);
    // What was asked for stands beside its own button: how long it has taken, what came out, or why nothing did.
    const put_step = (step, id, idle) =>
      put(id, busy === step ? (doing ? `Looking at the frames: ${doing} …` : LOOKING) : failed[step] ? sentence(failed[step]) : measured[step] ?? idle);
    const count = findings?.length ?? 0;
    put_step("ball", "ball-note", "Centre and radius are measured together, from the frames of the last seconds: move the camera around the ball, then press.");
    put_step("light", "light-by-card", "Without a ball: the light is estimated from card, planes and boxes in the newest frame; later changes are not followed.");
    put_step("response", "response-note", "The camera's response curve, measured from the card's grey patches under different exposures or lights.");
    put_step("check", "check-note", findings ? (count ? `${count} finding${count === 1 ? "" : "s"}, the worst first:` : "Nothing wrong was found.") : outdated ? "The set-up has changed since the last check: check it again." : "Units, card, camera, ball and light are checked in the frames of the last seconds.");
    $("response-file").hidden = !measured.response;
    $("findings").replaceChildren(...(findings ?? []).map((one) => el("li", {}, sentence(one.text), el("small", {}, `Spoils: ${one.cost}.`), el("small", {}, `To do: ${remedy(one)}`))));
    if (busy === null) return void (this.#busy = null);
    // Seconds are for the eye alone: a status that is set anew is read out anew.
    if (busy !== this.#busy) this.#began = performance.now();
    this.#busy = busy;
    const began = this.#began;
    const seconds = el("span", { "aria-hidden": "true" });
    $({ ball: "ball-note", light: "light-by-card", response: "response-note", check: "check-note" }[busy]).append(seconds);
    this.#clock = setInterval(() => (seconds.textContent = ` ${Math.round((performance.now() - began) / 1000)} s`), 1000);
  }
}

const LOOKING = "Looking at the frames, which takes some seconds …";
const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`;
// What the page has a button for is not to be written into a file.
const remedy = ({ name, remedy }) => (["marker.other", "marker.board"].includes(name) ? "Press “Use the card with these sizes” if it is the printed card." : sentence(remedy));

/** Text of an element, set only where it changes: what is set anew is read out anew. */
function put(id, text, inside = false) {
  const element = inside ? $(id).firstElementChild : $(id);
  if (element.textContent !== text) element.textContent = text;
}
