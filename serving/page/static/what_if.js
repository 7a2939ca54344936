// Courses of the signals after a change or with a course to come, beside those without it, before anybody confirms it.
import { foresee } from "./api.js";
import { foresees, moves } from "./foresight.js";
import { duration, element, number, unit } from "./format.js";

const SVG = "http://www.w3.org/2000/svg";
const STILL = 2e-3; // of a signal's range: what moves by more over the last fifth of the horizon has not come to rest
const [WIDE, TALL] = [88, 24]; // pixels of the lines beside a name

// A table of what the signals would do, beside what they do without it, and what it does not show; null where the law
// cannot be asked. body: {changes: values by name}, or {course: as a loop is given one}. value(name): an entry of operate,
// undefined where there is none.
export function whatIf(body, signals, value) {
  return foresees() ? looked(body, signals, value) : null;
}

async function looked(body, signals, value) {
  const { before, after, course_s } = await foresee(body);
  const changes = body.changes || {};
  const values = (of, signal) => of.courses.find((c) => c.signal === signal.name)?.values;
  const rows = signals.filter((s) => values(after, s) !== undefined);
  const last = Math.max(...after.courses.map((c) => c.times_s.at(-1)));
  const cell = (s, of) => element("td", {}, `${number(values(of, s).at(-1), s)} ${unit(s)}`.trim());
  const between = (s) => [Math.min, Math.max].map((of) => number(of(...values(after, s)), s)).join(" … ");
  const lines = (s) => drawn([[values(before, s), "before"], [values(after, s), "after"]], s);
  const heads = ["", "as it is", body.course ? "with it" : "changed", "on the way"];
  const table = element(
    "table",
    {},
    element("caption", {}, `${moves() ? "In" : "In AUTO, after"} ${duration(last)}, by the law's own model. The lines are the way there, dashed as it is`),
    element("thead", {}, element("tr", {}, ...heads.map((words) => element("th", {}, words)))),
    element("tbody", {}, ...rows.map((s) => element("tr", {}, element("th", { scope: "row" }, s.name, lines(s)), cell(s, before), cell(s, after), element("td", {}, between(s))))),
  );
  const notes = [
    ...rows.flatMap((s) => unheld(s, changes, values(after, s), value, last)),
    ...resting(rows, changes, (s) => values(after, s), value),
    ...onward(rows, changes, (s) => values(after, s), last),
    ...(course_s > last ? [`The course goes on until ${duration(course_s)} from now. Nothing after ${duration(last)} is looked at.`] : []),
  ];
  return element("div", {}, table, ...notes.map((words) => element("p", { class: "hint", "data-note": "" }, words)));
}

// Courses as lines over the same time, between the lowest and the highest value of them all; the table has the numbers.
function drawn(courses, signal) {
  const all = courses.flatMap(([values]) => values);
  const least = STILL * (signal.high - signal.low); // what hardly moves is drawn flat
  const [low, high] = [Math.min(...all), Math.max(...all)];
  const [middle, span] = [(low + high) / 2, Math.max(high - low, least)];
  const made = document.createElementNS(SVG, "svg");
  made.setAttribute("viewBox", `0 0 ${WIDE} ${TALL}`);
  made.setAttribute("aria-hidden", "true");
  for (const [values, name] of courses) {
    const line = document.createElementNS(SVG, "polyline");
    const x = (k) => (1 + ((WIDE - 2) * k) / Math.max(1, values.length - 1)).toFixed(1);
    const y = (v) => (TALL / 2 - ((TALL - 4) * (v - middle)) / span).toFixed(1);
    line.setAttribute("class", name);
    line.setAttribute("points", values.map((v, k) => `${x(k)},${y(v)}`).join(" "));
    made.append(line);
  }
  return made;
}

const fifth = (of) => of.at(-1) - of.at(-1 - Math.ceil(of.length / 5));
const way = (s, of) => (Math.abs(fifth(of)) <= STILL * (s.high - s.low) ? "" : fifth(of) > 0 ? "rises" : "falls");

// A variable that the change takes out: whether it leaves its range, or goes on and on, as a level does.
function unheld(s, changes, course, value, last) {
  if (changes[`${s.name}.use`] !== 0) return [];
  const [low, high] = ["low", "high"].map((end) => changes[`${s.name}.${end}`] ?? value(`${s.name}.${end}`) ?? s[end]);
  const gone = course.findIndex((v) => v < low || v > high);
  if (gone < 0) return [`Nothing holds ${s.name} then.${way(s, course) && ` After ${duration(last)} it still ${way(s, course)}.`}`];
  const time = duration(((gone + 1) * last) / course.length);
  return [`▲ Nothing holds ${s.name} then: after ${time} it is ${course[gone] > high ? "above" : "below"} its range, ${number(low, s)} … ${number(high, s)} ${unit(s)}`.trim() + "."];
}

// MVs that go to their resting values once a variable is taken out: they take it with them, as an outlet does a level.
function resting(rows, changes, course, value) {
  const out = rows.filter((s) => changes[`${s.name}.use`] === 0).map((s) => s.name);
  const of = (s, what) => changes[`${s.name}.${what}`] ?? value(`${s.name}.${what}`);
  const going = rows.filter((s) => {
    const [rest, from, to] = [of(s, "rest"), course(s)[0], course(s).at(-1)];
    return of(s, "use") === 1 && of(s, "rest_use") === 1 && Math.abs(to - rest) + STILL * (s.high - s.low) < Math.abs(from - rest);
  });
  if (!out.length) return [];
  return going.map((s) => `${s.name} goes to its resting value, ${number(of(s, "rest"), s)} ${unit(s)}`.trim() + `, whatever that does to ${out.join(", ")}.`);
}

// The end of the horizon is not the end of what happens.
function onward(rows, changes, course, last) {
  const moving = rows.filter((s) => way(s, course(s))).map((s) => `${s.name} still ${way(s, course(s))}`);
  const costs = Object.keys(changes).some((name) => name.endsWith(".cost"));
  return [
    ...(moving.length ? [`The plant does not rest after ${duration(last)}: ${moving.join(", ")}.`] : []),
    ...(costs ? ["A cost acts slowly. It moves the plant on until a range or a limit stops it."] : []),
  ];
}
