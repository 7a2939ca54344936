// A course that an operator gives: steps of a signal by hand, or a file of several signals.
import { ask } from "./dialog.js";
import { clock, element, number, unit, zone } from "./format.js";
import { foreseeCourse } from "./operate.js";

const UNITS = { s: 1, min: 60, h: 3600 };
const CLOCK = "clock";
const FIRST_S = 600; // from now, where the first step stands before it is changed
const LONGEST_FILE = 90_000; // bytes: what a request may have, with some of them for the rest of it
const LONGEST_LOOK = 9_000; // bytes of a file that is looked at beforehand, for which nobody has to have the token
const HOLDS = [["", "holds each value until the next"], ["straight", "runs straight to each value"]];
let heard = { time: 0, at: 0 }; // a time of the loop, and when this browser heard of it

// The loop's time now, whatever this machine's clock says.
export const hear = ({ time }) => {
  if (time !== heard.time) heard = { time, at: Date.now() / 1000 };
};
const now = () => heard.time + Date.now() / 1000 - heard.at;

// A time with seconds only where it has some.
export const shownTime = (seconds) => clock(Math.round(seconds)).replace(/:00$/, "");

const option = (value, words) => element("option", { value }, words);
const labelled = (words, field) => element("label", {}, `${words} `, field);
const wrongLine = (name) => element("span", { class: "wrong", id: `wrong-${name}` });

// ----------------------------------------------------------------------------------------------------------- by hand
export function byHand(about) {
  const speed = about.speed || 1;
  const { sp, dv } = about.signals;
  const signal = element("select", { id: "course-signal" }, ...[...sp, ...dv].map((s) => option(s.name, dv.includes(s) ? `${s.name}, forecast` : s.name)));
  const times = element(
    "select",
    { id: "course-times" },
    ...[["min", "minutes from now"], ["s", "seconds from now"], ["h", "hours from now"], [CLOCK, `by the clock (${zone()})`]].map((of) => option(...of)),
  );
  const way = element("select", { id: "course-way" }, ...HOLDS.map((of) => option(...of)));
  const steps = element("div", { id: "course-steps" });
  const more = element("button", { type: "button", id: "course-more" }, "Another step");
  const chosen = () => [...sp, ...dv].find((s) => s.name === signal.value);
  const rows = () => [...steps.children];
  const field = (row, what) => row.querySelector(`[data-what="${what}"]`);

  function add(seconds) {
    const time = element("input", { "data-what": "time", required: true });
    const value = element("input", { "data-what": "value", type: "number", step: "any", required: true });
    const drop = element("button", { type: "button", class: "drop" }, "Remove");
    const row = element("div", { class: "step", role: "group" }, labelled("Time", time), labelled("Value", value), drop, element("span", { class: "wrong" }));
    drop.addEventListener("click", () => {
      const next = row.nextElementSibling || row.previousElementSibling;
      row.remove();
      name();
      (next ? field(next, "time") : more).focus();
      steps.dispatchEvent(new Event("input", { bubbles: true }));
    });
    steps.append(row);
    asTime(time, seconds);
    name();
    return row;
  }

  // Names by place, which are those that the loop refuses by; and what a value may be.
  function name() {
    const s = chosen();
    rows().forEach((row, k) => {
      const named = `${s.name}.${k + 1}`;
      Object.assign(field(row, "value").dataset, { field: named, said: `step ${k + 1}` });
      row.querySelector(".wrong").id = `wrong-${named}`;
      row.setAttribute("aria-label", `Step ${k + 1}`);
      field(row, "time").setAttribute("aria-label", `Time of step ${k + 1}, ${times.selectedOptions[0].textContent}`);
      field(row, "value").setAttribute("aria-label", `Value of step ${k + 1}${unit(s) && ` in ${unit(s)}`}, ${s.low} to ${s.high}`);
      row.querySelector(".drop").setAttribute("aria-label", `Remove step ${k + 1}`);
      row.querySelector(".drop").hidden = rows().length < 2;
    });
    way.closest("label").hidden = dv.includes(s) || Boolean(s.values);
    range.textContent = `Allowed are ${s.low} to ${s.high} ${unit(s)}`.trim() + (dv.includes(s) ? "; a forecast runs straight from point to point, and only its changes count." : ".");
  }

  // Seconds of the loop from now, written as the times are.
  function asTime(field, seconds) {
    field.type = times.value === CLOCK ? "datetime-local" : "number";
    field.step = times.value === CLOCK ? 1 : "any";
    field.closest(".step").classList.toggle("dated", times.value === CLOCK); // a date needs the whole width
    if (times.value === CLOCK) {
      const at = new Date((now() + seconds / speed) * 1000);
      field.value = new Date(at - at.getTimezoneOffset() * 60_000).toISOString().slice(0, 19);
    } else field.value = String(+(seconds / UNITS[times.value]).toPrecision(6));
  }

  function seconds(field, of = times.value) {
    if (of === CLOCK) return Math.round((new Date(field.value).getTime() / 1000 - now()) * speed * 10) / 10;
    return Number(field.value) * UNITS[of];
  }

  const given = () => rows().map((row) => [seconds(field(row, "time")), Number(field(row, "value").value)]);
  const straight = () => way.value && !way.closest("label").hidden;
  const value = () => ({ points: { [signal.value]: given() }, ...(straight() ? { straight: [signal.value] } : {}) });
  const range = element("p", { class: "hint" });
  const body = element("div", {}, labelled("Signal", signal), labelled("Times", times), labelled("The set point", way), range, steps, more);
  let before = times.value;
  times.addEventListener("change", () => {
    for (const row of rows()) {
      const found = seconds(field(row, "time"), before);
      asTime(field(row, "time"), Number.isFinite(found) ? found : FIRST_S);
    }
    before = times.value;
    name();
  });
  signal.addEventListener("change", name);
  more.addEventListener("click", () => {
    const last = given().at(-1)?.[0];
    field(add((Number.isFinite(last) ? last : 0) + FIRST_S), "value").focus();
  });
  add(FIRST_S);
  ask({
    title: "Course by hand",
    words: "Steps that are known before they come. The law reads them ahead; a set point takes each when its time comes.",
    body,
    said: () => {
      const s = chosen();
      const filled = rows().filter((row) => field(row, "value").value !== "" && field(row, "time").value !== "");
      const shown = filled.map((row) => `${number(Number(field(row, "value").value), s)} ${unit(s)}`.trim() + ` at ${shownTime(now() + seconds(field(row, "time")) / speed)}`);
      return shown.length ? `${s.name}: ${shown.join(", ")}` : "";
    },
    foresee: () => (rows().every((row) => field(row, "value").value !== "" && Number.isFinite(seconds(field(row, "time")))) ? foreseeCourse(value()) : null),
    request: () => ({ do: "course", value: value() }),
  });
}

// --------------------------------------------------------------------------------------------------------- by a file
export function byFile(about) {
  const { sp } = about.signals;
  const file = element("input", { type: "file", id: "course-file", accept: ".csv,text/csv", required: true, "data-field": "csv", "data-said": "the file" });
  const boxes = sp.filter((s) => !s.values).map((s) => element("input", { type: "checkbox", value: s.name }));
  const lines = boxes.map((box) => element("label", { class: "choice" }, box, ` ${box.value}`));
  const ways = element("fieldset", {}, element("legend", {}, "Runs straight to each value, and does not hold it until the next"), ...lines);
  let text = "";
  let said = "";
  function value() {
    const straight = boxes.filter((box) => box.checked).map((box) => box.value);
    return { csv: text, ...(straight.length ? { straight } : {}) };
  }
  file.addEventListener("change", async () => {
    const chosen = file.files[0];
    [text, said] = ["", ""];
    if (chosen) {
      text = await chosen.text();
      const rows = text.split(/\r?\n/).filter((line) => line.trim());
      said = rows.length ? `${chosen.name}: ${rows[0]}; ${rows.length - 1} line${rows.length === 2 ? "" : "s"} below` : `${chosen.name} is empty`;
    }
    file.dispatchEvent(new Event("input", { bubbles: true }));
  });
  ask({
    title: "Course from a file",
    words: "A CSV file: a column of times, and one of values for each signal. Times are seconds from now, or as 2026-03-01T14:30 (UTC).",
    body: element("div", {}, labelled("File", file), wrongLine("csv"), lines.length ? ways : null),
    said: () => said,
    foresee: () => {
      if (!text) return null;
      if (new Blob([text]).size > LONGEST_LOOK) return element("p", { class: "hint" }, `A file of more than ${LONGEST_LOOK} bytes is not looked at beforehand.`);
      return foreseeCourse(value());
    },
    request: () => {
      if (new Blob([text]).size > LONGEST_FILE) {
        throw Object.assign(new Error(`The file has more than ${LONGEST_FILE} bytes. Give fewer points, or use the command: loopwright loop course.`), { entry: "csv" });
      }
      return { do: "course", value: value() };
    },
  });
}
