// Courses that stand: set points and forecasts of disturbances to come, listed, drawn right of now, and taken back.
import { get } from "./api.js";
import { ask } from "./dialog.js";
import { byFile, byHand, shownTime } from "./course_entry.js";
import { duration, element, number, say, unit } from "./format.js";
import { foreseeCourse } from "./operate.js";

const $ = (id) => document.getElementById(id);
const SHARE = 0.4; // of the time that is shown, which the future may have beside it
const MARK = 2; // pixels from the middle of a point's mark to its side
const BEFORE = 4; // pixels before a word beside the line of now
let about = null;
let state = null;
let points = new Map(); // signal -> { number, points: [[seconds from its end, value]], straight, who }
let asking = false;
let laid = "";

export function describe(found) {
  about = found;
  points = new Map();
  laid = "";
  for (const id of ["course-by-hand", "course-by-file"]) $(id).hidden = !about.ahead; // a law may leave a course behind
  $("course-by-hand").onclick = () => byHand(about);
  $("course-by-file").onclick = () => byFile(about);
}

export const show = (found) => {
  state = found;
  list();
};

const standing = () => (about ? Object.entries(state?.courses || {}) : []);
const signalOf = (name) => [...about.signals.sp, ...about.signals.dv].find((s) => s.name === name);
const isDv = (name) => about.signals.dv.some((s) => s.name === name);

// The points of the courses are asked for where one is new; true where something came.
export async function refresh() {
  const known = standing().every(([name, { number }]) => points.get(name)?.number === number);
  if (known || asking) return false;
  asking = true;
  try {
    points = new Map((await get("/api/courses")).courses.map((course) => [course.signal, course]));
    laid = "";
    list();
    return true;
  } catch {
    return false; // asked for again with the next state
  } finally {
    asking = false;
  }
}

const speed = () => about.speed || 1;
const ends = ({ ends_in_s }) => state.time + (about.period_s + ends_in_s) / speed(); // since 1970

// [time since 1970, value] of a signal's course from now on; empty without one.
function toCome(name, now = state?.time) {
  const stands = state?.courses?.[name];
  const known = points.get(name);
  if (!stands || known?.number !== stands.number) return [];
  const end = ends(stands);
  const all = known.points.map(([t, v]) => [end + t / speed(), v]);
  const next = all.findIndex(([t]) => t > now);
  if (next < 0) return [];
  return [[now, present(name, now, all[next - 1], all[next])], ...all.slice(next)];
}

// Its value now: between the points around it where it runs straight, else as it stands.
function present(name, now, before, after) {
  const group = isDv(name) ? "dv" : "sp";
  const stands = state[group]?.[about.signals[group].findIndex((s) => s.name === name)] ?? after[1];
  if (!before || (group === "sp" && !points.get(name).straight)) return stands;
  return after[0] > before[0] ? before[1] + ((after[1] - before[1]) * (now - before[0])) / (after[0] - before[0]) : after[1];
}

// ------------------------------------------------------------------------------------------------------ in the trends
// The seconds after now that are drawn beside `span` seconds of the past.
export function ahead(span) {
  const last = Math.max(0, ...standing().map(([, of]) => ends(of) - state.time));
  return last ? Math.min(1.1 * last, SHARE * span) : 0; // with some air after the last step
}

// The values of a course until a time, for the scale of its chart.
export function near(signal, low, high, to) {
  const drawn = about && signal.name ? toCome(signal.name).filter(([t]) => t <= to) : [];
  const values = drawn.map(([, v]) => v);
  return [Math.min(low, ...values), Math.max(high, ...values)];
}

// Over the lines of a plot: steps, or straight lines, with a mark at each point. `after`: the end of a word that stands above.
export function draw(u, signal, after, color) {
  const newest = Math.max(state?.time || 0, u.data[0].at(-1) || 0); // scans come in between two states
  const found = about ? toCome(signal.name, newest) : [];
  const { ctx, bbox } = u;
  const right = bbox.left + bbox.width;
  const x = (t) => u.valToPos(t, "x", true);
  const shown = found.length && x(found[0][0]) < right - 2;
  u.root.parentElement?.setAttribute("data-course", shown ? found.length - 1 : 0); // for tests, which cannot read a canvas
  if (!shown) return;
  const straight = isDv(signal.name) || points.get(signal.name).straight;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, 0, bbox.width, bbox.top + bbox.height);
  ctx.clip();
  ctx.strokeStyle = ctx.fillStyle = color("sp");
  ctx.lineWidth = 1.5 * devicePixelRatio;
  ctx.setLineDash([]); // uPlot leaves what its last line needed
  ctx.beginPath();
  let before = 0;
  found.forEach(([t, v], k) => {
    const y = u.valToPos(v, "y", true);
    if (!k) ctx.moveTo(x(t), y);
    else if (!straight) ctx.lineTo(x(t), before); // it stays until the next step
    ctx.lineTo(x(t), y);
    before = y;
  });
  if (!isDv(signal.name)) ctx.lineTo(right, before); // a forecast says nothing of later
  ctx.stroke();
  const side = MARK * devicePixelRatio;
  for (const [t, v] of found.slice(1)) ctx.fillRect(x(t) - side, u.valToPos(v, "y", true) - side, 2 * side, 2 * side);
  word(u, found[0][0], after, color("ink-2"));
  ctx.restore();
}

// The word "course" right of the line of now, where there is room for it; a prediction has drawn that line already.
function word(u, now, after, ink) {
  const { ctx, bbox } = u;
  const begin = u.valToPos(now, "x", true);
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "left";
  ctx.fillStyle = ctx.strokeStyle = ink;
  const said = after ? ", course" : "course";
  const at = after || begin + BEFORE * devicePixelRatio;
  if (at + ctx.measureText(said).width < bbox.left + bbox.width) ctx.fillText(said, at, bbox.top - 5 * devicePixelRatio);
  if (after) return;
  ctx.lineWidth = devicePixelRatio;
  ctx.beginPath();
  ctx.moveTo(begin, bbox.top);
  ctx.lineTo(begin, bbox.top + bbox.height);
  ctx.stroke();
}

// ------------------------------------------------------------------------------------------------------- in the list
function list() {
  if (!about) return;
  const found = standing();
  $("courses").hidden = !about.ahead && !found.length;
  const layout = JSON.stringify(found.map(([name, { number, who, at }]) => [name, number, who, at, points.get(name)?.number]));
  if (layout !== laid) {
    const held = document.activeElement?.closest("#course-list [data-course-of]")?.dataset.courseOf;
    $("course-list").replaceChildren(...(found.length ? found.map(row) : [element("li", { class: "calm" }, "none: all stay as they are")]));
    $("course-end-all").hidden = found.length < 2;
    $("course-end-all").onclick = () => askEnd(standing().map(([name]) => name));
    if (held) ($("course-list").querySelector(`[data-course-of="${CSS.escape(held)}"] button`) || $("course-by-hand")).focus();
  }
  laid = layout;
  for (const [name, of] of found) {
    const line = $("course-list").querySelector(`[data-course-of="${CSS.escape(name)}"] .what`);
    if (line) say(line, words(name, of));
  }
}

function row([name, of]) {
  return element(
    "li",
    { "data-course-of": name },
    element("strong", {}, name),
    element("span", { class: "who" }, [isDv(name) ? "forecast" : "", of.who && `by ${of.who}`].filter(Boolean).join(", ")),
    element("button", { type: "button", "aria-label": `End the course of ${name}…`, onclick: () => askEnd([name]) }, "End…"),
    element("span", { class: "what" }),
  );
}

// The next point and the last one; the seconds are the loop's own.
function words(name, of) {
  const signal = signalOf(name);
  const shown = (v) => `${number(v, signal)} ${unit(signal)}`.trim();
  const point = (t, v) => `${shown(v)} at ${shownTime(t)}, in ${duration(Math.max(0, Math.round((t - state.time) * speed())))}`;
  const [, next, ...more] = toCome(name);
  if (!next) return `to ${point(ends(of), of.at)}`;
  const last = more.at(-1);
  const between = more.length > 1 ? `; ${more.length - 1} more between` : "";
  return `to ${point(...next)}${last ? `; last ${point(...last)}${between}` : ""}`;
}

function askEnd(names) {
  ask({
    title: `End the course of ${names.join(", ")}`,
    words: names.every(isDv)
      ? "The disturbance counts as it is measured."
      : "A set point stays where it is now; a disturbance counts as it is measured.",
    foresee: () => foreseeCourse({ end: names }),
    request: () => ({ do: "course", value: { end: names } }),
  });
}
