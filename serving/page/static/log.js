// Alarms, and the journal of what happened.
import { get } from "./api.js";
import { ask } from "./dialog.js";
import { clock, element, here, say } from "./format.js";

const $ = (id) => document.getElementById(id);
const MOST = 300;
const WHO = { loop: "the loop", plant: "the plant", monitor: "the monitor", opcua: "the connection", "loop.toml": "the settings" };
const known = new Map();
let came = null; // events that come in while the list is loaded: they are newer than it
let drawn = "";

export async function load() {
  const mine = (came = new Map());
  const found = await get("/api/events?limit=200");
  if (mine !== came) return; // a later load overtook this one
  known.clear();
  for (const event of [...found.events, ...mine.values()]) known.set(event.id, event);
  came = null;
  draw();
}

export function add(event) {
  known.set(event.id, event);
  came?.set(event.id, event);
  const past = [...known.values()].filter((e) => !e.alarm || (e.over && e.acknowledged));
  if (past.length > 2 * MOST) for (const e of past.sort((a, b) => a.id - b.id).slice(0, MOST)) known.delete(e.id);
  draw();
}

export const unacknowledged = () => [...known.values()].filter((e) => e.alarm && !e.acknowledged).length;

function draw() {
  const all = [...known.values()].sort((a, b) => b.id - a.id);
  const urgent = (e) => (e.acknowledged ? 0 : 2) + (e.over ? 0 : 1);
  const alarms = all.filter((e) => e.alarm).sort((a, b) => urgent(b) - urgent(a) || b.id - a.id).slice(0, 50);
  list(alarms);
  $("events").replaceChildren(...all.filter((e) => !e.alarm).slice(0, 100).map(happened));
  const [count, active] = [unacknowledged(), alarms.filter((e) => !e.over).length];
  const counts = [active ? `${active} active` : "", count ? `${count} not acknowledged` : ""].filter(Boolean);
  say($("alarm-count"), counts.length ? `▲ ${counts.join(", ")}` : "");
  document.title = (count ? `(${count}) ` : "") + ($("title").textContent || "Loopwright");
}

// Written only where something is new, and then the focus goes back to the alarm that had it.
function list(alarms) {
  const text = JSON.stringify(alarms);
  if (text === drawn) return;
  drawn = text;
  const held = document.activeElement?.closest("#alarm-list [data-id]")?.dataset.id;
  $("alarm-list").replaceChildren(...(alarms.length ? alarms.map(alarm) : [element("li", { class: "calm" }, "none")]));
  if (held) ($("alarm-list").querySelector(`[data-id="${held}"] button`) || $("alarm-list").querySelector("button"))?.focus();
}

function alarm(e) {
  const stands = e.over ? `over at ${clock(e.over)}` : "active";
  const level = e.acknowledged ? (e.over ? "past" : "seen") : e.over ? "past-unseen" : "active";
  const sign = { active: "▲", "past-unseen": "△", seen: "■", past: "·" }[level];
  const seen = e.acknowledged && `seen by ${e.acknowledged.who} at ${clock(e.acknowledged.time)}${e.acknowledged.reason ? `: ${e.acknowledged.reason}` : ""}`;
  return element(
    "li",
    { class: `alarm ${level}`, "data-id": e.id, "data-level": level },
    element("span", { class: "sign", "aria-hidden": "true" }, sign),
    element("time", {}, clock(e.time)),
    element("span", { class: "what" }, here(e.what) + (e.reason ? ` (${e.reason})` : "")),
    element("span", { class: "stands" }, stands),
    e.acknowledged
      ? element("span", { class: "seen" }, seen)
      : element("button", { type: "button", class: "acknowledge", "aria-label": `Acknowledge… ${clock(e.time)} ${here(e.what)}`, onclick: () => acknowledge(e) }, "Acknowledge…"),
  );
}

function acknowledge(e) {
  ask({ title: "Acknowledge the alarm", words: `${clock(e.time)}: ${here(e.what)}`, request: () => ({ do: "acknowledge", value: e.id }) });
}

function happened(e) {
  return element(
    "li",
    { "data-kind": e.kind },
    element("time", {}, clock(e.time)),
    element("span", { class: "who" }, WHO[e.who] || e.who),
    element("span", { class: "what" }, happenedTo(e) + (e.reason ? ` (${e.reason})` : "")),
  );
}

function happenedTo(e) {
  const what = here(e.what);
  if (e.kind === "acknowledged") return `acknowledged: ${what}`;
  return what.startsWith("over") ? `the ${e.kind} is ${what}` : what;
}
