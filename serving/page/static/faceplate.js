// Mode, values, and what an operator may change.
import { ask } from "./dialog.js";
import { element, number, say, unit } from "./format.js";

const $ = (id) => document.getElementById(id);
const MODES = {
  SHADOW: "The law is computed and shown; nothing is written.",
  MANUAL: "The operator sets the MV.",
  AUTO: "The law sets the MV.",
  HOLD: "The last MV stays.",
};
let about = null;
let state = null;

export function describe(found) {
  about = found;
  $("modes").replaceChildren(
    ...Object.keys(MODES).map((mode) => element("button", { type: "button", "data-mode": mode, onclick: () => askMode(mode) }, mode)),
  );
}

export function show(found) {
  state = found;
  const mode = $("mode");
  say(mode, state.mode);
  mode.dataset.mode = state.mode;
  $("mode-words").textContent = MODES[state.mode] || "";
  $("reason").hidden = !state.reason;
  say($("reason"), state.reason ? `▲ ${state.reason}` : "");
  for (const button of $("modes").children) button.setAttribute("aria-pressed", button.dataset.mode === state.mode);
  $("change-sp").disabled = !about; // without the signals a click would do nothing
  $("change-mv").disabled = !about || state.mode !== "MANUAL";
  $("change-mv").title = state.mode === "MANUAL" ? "" : "in MANUAL only";
  if (about && state.pv !== undefined) $("values").replaceChildren(...rows());
  trial();
}

function rows() {
  const { sp, pv, mv, dv } = about.signals;
  const quality = state.quality || [];
  const made = [];
  pv.forEach((s, i) => {
    if (i < sp.length) made.push(row("SP", sp[i], at(state.sp, i)));
    made.push(row("PV", s, at(state.pv, i), quality[i], i < sp.length ? at(state.sp, i) : null));
  });
  mv.forEach((s, i) => {
    const writes = state.mv !== null && state.mv !== undefined;
    if (writes) made.push(row("MV asked", s, at(state.mv, i)));
    else made.push(row("Law's MV", s, at(state.law, i), null, null, "not written"));
    made.push(row("MV applied", s, at(state.applied, i), quality[pv.length + i]));
    if (state.beside) made.push(row("Successor's MV", s, at(state.beside, i), null, null, "not written"));
  });
  dv.forEach((s, i) => made.push(row("DV", s, at(state.dv, i), quality[pv.length + mv.length + i])));
  return made;
}

const at = (values, i) => (values ? values[i] : null);

function row(kind, signal, value, quality, mark = null, words = "") {
  const bad = quality && quality !== "Good";
  const share = (v) => (v === null ? 0 : Math.min(100, Math.max(0, (100 * (v - signal.low)) / (signal.high - signal.low))));
  const fill = element("div", { class: "fill" });
  fill.style.width = `${share(value)}%`;
  const bar = element("div", { class: "bar", title: `${signal.low} … ${signal.high} ${unit(signal)}` }, fill);
  if (mark !== null) {
    const line = element("div", { class: "mark" });
    line.style.left = `${share(mark)}%`;
    bar.append(line);
  }
  return element(
    "div",
    { class: bad ? "value bad" : "value", "data-signal": `${kind} ${signal.name}` },
    element("span", { class: "kind" }, kind),
    element("span", { class: "name" }, signal.name),
    element("span", { class: "number" }, number(value, signal)),
    element("span", { class: "unit" }, unit(signal)),
    bar,
    element("span", { class: "quality" }, bad ? `▲ ${quality}` : words),
  );
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
    request: (values) => ({ do: what, value: values }),
  });
}

const choice = (value, signal) => String(Number(number(value, signal)));

// What stands in the field at first: the present value as it is shown; of a discrete signal the nearest it may have.
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
  const progress = element("progress", { max: next.trial, value: Math.min(next.good, next.trial) });
  const keep = () => ask({ title: "End the trial", words: `${next.law} goes; the controller in charge stays.`, request: () => ({ do: "keep" }) });
  const words = `${next.law} (${next.file}) is on trial: ${next.good} of ${next.trial} good scans.`;
  if (box.dataset.of !== next.sha256) {
    box.dataset.of = next.sha256;
    box.replaceChildren(element("p", { id: "trial-words" }), progress, element("button", { id: "keep", type: "button", onclick: keep }, "Keep the old one…"));
  }
  $("trial-words").textContent = words + (next.reason ? ` It began anew: ${next.reason}.` : "");
  box.querySelector("progress").value = Math.min(next.good, next.trial);
}
