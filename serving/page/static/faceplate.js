// Mode, values, and what an operator may change.
import { ask } from "./dialog.js";
import { element, number, say, unit } from "./format.js";
import * as operate from "./operate.js";

const $ = (id) => document.getElementById(id);
const MODES = {
  SHADOW: "The plant's own side moves the MV. The law is computed and shown; nothing is written.",
  MANUAL: "The operator sets the MV.",
  AUTO: "The law sets the MV.",
  HOLD: "The last MV stays.",
};
let about = null;
let state = null;
let laid = ""; // what the values that stand on the page were laid out for

export function describe(found) {
  about = found;
  operate.describe(about);
  laid = "";
  if ($("modes").children.length) return;
  $("modes").replaceChildren(
    ...Object.keys(MODES).map((mode) => element("button", { type: "button", "data-mode": mode, onclick: () => askMode(mode) }, mode)),
  );
}

export function show(found) {
  state = found;
  // Said when the mode changes, and not at each scan that words its reason anew.
  if ($("mode").textContent !== state.mode) say($("spoken"), `${state.mode}${state.reason ? `: ${state.reason}` : ""}`);
  for (const mode of [$("mode"), $("standing")]) {
    say(mode, state.mode);
    mode.dataset.mode = state.mode;
  }
  $("mode-words").textContent = MODES[state.mode] || "";
  $("reason").hidden = !state.reason;
  say($("reason"), state.reason ? `▲ ${state.reason}` : "");
  for (const button of $("modes").children) button.setAttribute("aria-pressed", button.dataset.mode === state.mode);
  $("change-sp").disabled = !about; // without the signals a click would do nothing
  $("change-mv").disabled = !about || state.mode !== "MANUAL";
  $("change-mv").title = state.mode === "MANUAL" ? "" : "all of them in MANUAL only; a single one at its own faceplate";
  $("legend").hidden = !about;
  if (about && state.pv !== undefined) values();
  if (about) leftOut();
  trial();
}

// The signals that the law does not have, above the alarms: also those that somebody took out, which is no alarm.
function leftOut() {
  const found = operate.leftOut(state, about.signals);
  const text = JSON.stringify(found);
  if ($("left-out").dataset.of === text) return;
  $("left-out").dataset.of = text;
  $("left-out").hidden = !found.length;
  $("left-out").replaceChildren(...found.map(({ name, words }) => element("li", { "data-out": name }, element("strong", {}, name), ` ${words}`)));
}

// A block a signal: its values side by side, and a bar of its range. It is laid out once, and then filled.
function values() {
  const { sp, pv, mv, dv } = about.signals;
  const quality = state.quality || [];
  const writes = Boolean(state.mv);
  const blocks = [
    ...pv.map((s, i) => [
      "pv",
      s,
      i,
      [...(i < sp.length ? [["SP", at(state.sp, i), "", ""]] : []), ["PV", at(state.pv, i), quality[i], ""]],
      [at(state.pv, i), i < sp.length ? at(state.sp, i) : null],
    ]),
    ...mv.map((s, i) => {
      const [wanted, applied] = [at(writes ? state.mv : state.law, i), at(state.applied, i)];
      const cells = [
        writes ? ["MV asked", wanted, "", end(wanted, s)] : ["Law's MV", wanted, "", "not written"],
        ["MV applied", applied, quality[pv.length + i], ""],
      ];
      if (state.beside) cells.push(["Successor's MV", at(state.beside, i), "", "not written"]);
      return ["mv", s, i, cells, [applied, wanted]];
    }),
    ...dv.map((s, i) => ["dv", s, i, [["DV", at(state.dv, i), quality[pv.length + mv.length + i], ""]], [at(state.dv, i), null]]),
  ];
  const layout = JSON.stringify([about.title, blocks.map(([, s, , cells]) => [s.name, cells.map(([kind]) => kind)])]);
  if (layout !== laid) {
    const whole = operate.part("law", null, state);
    $("values").replaceChildren(...blocks.map(([group, s, , cells]) => block(group, s, cells)), ...(whole ? [lawBlock(whole)] : []));
  }
  laid = layout;
  blocks.forEach(([group, s, i, cells, marks], at) => {
    const made = $("values").children[at];
    fill(made, s, cells, marks);
    const operated = made.querySelector(".operated");
    if (!operated) return;
    operate.fill(operated, group, s, state, i);
    operate.fillHand(made, s, state);
    within(made.querySelector(".within"), s, operate.range(s));
  });
  const whole = $("values").querySelector('[data-operated="law"]');
  if (whole) operate.fill(whole, "law", null, state, 0);
}

const lawBlock = (part) => element("div", { class: "signal", role: "group", "aria-label": "The whole law" }, headed("The whole law", "law", null), part);

// The name of a block, and the button that changes what operators may change of it.
function headed(name, group, signal) {
  const button = element("button", { type: "button", "data-change": signal ? name : "law", "aria-label": `Change ${name}…`, onclick: () => operate.askChange(group, signal) }, "Change…");
  const buttons = element("div", { class: "buttons" }, ...operate.handButtons(group, signal), button);
  return element("div", { class: "headed" }, element("h3", {}, name), buttons);
}

// The part of the bar that operators allow.
function within(box, signal, ends) {
  box.hidden = !ends;
  if (!ends) return;
  const [from, to] = ends.map((v) => share(v, signal));
  box.style.left = `${from}%`;
  box.style.width = `${to - from}%`;
}

const share = (v, signal) => Math.min(100, Math.max(0, (100 * (v - signal.low)) / (signal.high - signal.low)));

const at = (values, i) => (values ? values[i] : null);

// Where an MV can go no further.
const end = (value, { low, high, values }) => (value === null || values ? "" : value >= high ? "at its upper end" : value <= low ? "at its lower end" : "");

function block(group, signal, cells) {
  const range = `${number(signal.low, signal)} … ${number(signal.high, signal)} ${unit(signal)}`.trim();
  const operated = operate.part(group, signal, state);
  const inside = operated && element("div", { class: "within", hidden: true });
  const bar = element("div", { class: "bar", title: range, "aria-hidden": "true" }, inside, element("div", { class: "fill" }), element("div", { class: "mark" }));
  const made = cells.map(([kind]) =>
    element(
      "div",
      { class: "value", "data-signal": `${kind} ${signal.name}` },
      element("span", { class: "kind" }, kind),
      element("span", { class: "amount" }, element("span", { class: "number" }), " ", element("span", { class: "unit" }, unit(signal))),
      element("span", { class: "quality" }),
    ),
  );
  return element("div", { class: "signal", role: "group", "aria-label": signal.name }, operated ? headed(signal.name, group, signal) : element("h3", {}, signal.name), element("div", { class: "cells" }, ...made), bar, operated);
}

function fill(block, signal, cells, [value, mark]) {
  cells.forEach(([, number_, quality, words], i) => {
    const cell = block.querySelectorAll(".value")[i];
    const bad = Boolean(quality) && quality !== "Good";
    cell.classList.toggle("bad", bad);
    say(cell.querySelector(".number"), number(number_, signal));
    say(cell.querySelector(".quality"), bad ? `▲ ${quality}` : words);
  });
  block.querySelector(".fill").style.width = `${value === null ? 0 : share(value, signal)}%`;
  const line = block.querySelector(".mark");
  line.hidden = mark === null;
  if (mark !== null) line.style.left = `${share(mark, signal)}%`;
}

// News of what the law predicts, between two states.
export function foreseen() {
  if (about && state?.pv !== undefined) values();
}

function askMode(mode) {
  if (!state) return;
  ask({
    title: `${state.mode} → ${mode}`,
    words: MODES[mode] + (mode === "AUTO" && about.signals.sp.length ? ` Set point: ${points()}.` : ""),
    request: () => ({ do: "mode", value: mode }),
  });
}

const points = () =>
  about.signals.sp.map((s, i) => `${s.name} ${number(at(state.sp, i), s)} ${unit(s)}`).join(", ");

function askValues(title, words, signals, present, what) {
  ask({
    title,
    words,
    fields: signals.map((s, i) => ({
      name: s.name,
      label: `${s.name} [${unit(s) || "–"}], ${s.values ? s.values.map((v) => choice(v, s)).join(", ") : `${s.low} … ${s.high}`}`,
      now: at(present, i) === null ? "" : number(present[i], s),
      unit: unit(s),
      value: offered(at(present, i), s),
      min: s.low,
      max: s.high,
      choices: s.values && s.values.map((v) => [v, choice(v, s)]),
    })),
    foresee: what === "sp" ? operate.foresee : null,
    request: (values) => ({ do: what, value: values }),
  });
}

const choice = (value, signal) => String(Number(number(value, signal)));

// The value in the field at first: the present value as it is shown; of a discrete signal the nearest it may have.
function offered(value, signal) {
  if (value === null) return "";
  if (!signal.values) return Number(number(value, signal));
  return signal.values.reduce((best, v) => (Math.abs(v - value) < Math.abs(best - value) ? v : best));
}

$("change-sp").addEventListener("click", () => {
  if (about && state) askValues("Set point", "It takes effect with the next scan.", about.signals.sp, state.sp, "sp");
});
$("change-mv").addEventListener("click", () => {
  if (about && state) askValues("MV by hand", "It is written with the next scan.", about.signals.mv, state.mv, "mv");
});

function trial() {
  const box = $("trial");
  const next = state.successor;
  box.hidden = !next;
  if (!next) {
    delete box.dataset.of; // the same one may be tried again
    return box.replaceChildren();
  }
  const progress = element("progress", { "aria-label": "Good scans of the trial", max: next.trial, value: Math.min(next.good, next.trial) });
  const keep = () => ask({ title: "End the trial", words: `${next.law} goes; the controller in charge stays.`, request: () => ({ do: "keep" }) });
  const words = `${next.law} (${next.file}) is on trial: ${next.good} of ${next.trial} good scans.`;
  if (box.dataset.of !== next.sha256) {
    box.dataset.of = next.sha256;
    box.replaceChildren(element("p", { id: "trial-words" }), progress, element("button", { id: "keep", type: "button", onclick: keep }, "Keep the old one…"));
  }
  $("trial-words").textContent = words + (next.reason ? ` It began anew: ${next.reason}.` : "");
  box.querySelector("progress").value = Math.min(next.good, next.trial);
}
