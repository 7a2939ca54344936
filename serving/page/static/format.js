// How numbers, times and durations are written.

export function number(value, signal) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (signal?.values) return String(+value.toPrecision(4));
  const span = signal && signal.high > signal.low ? signal.high - signal.low : Math.abs(value) || 1;
  const digits = Math.min(8, Math.max(0, 3 - Math.floor(Math.log10(span))));
  return value.toFixed(digits);
}

export function unit(signal) {
  return signal.unit && signal.unit !== "-" ? signal.unit : "";
}

export function figure(value) {
  if (typeof value !== "number") return "–";
  return Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-4) ? value.toExponential(2) : String(+value.toPrecision(4));
}

const CLOCK = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const DAY = new Intl.DateTimeFormat(undefined, { day: "2-digit", month: "short" });
const ZONE = new Intl.DateTimeFormat(undefined, { timeZoneName: "short" });

export function clock(seconds) {
  const date = new Date(seconds * 1000);
  const today = new Date().toDateString() === date.toDateString();
  return (today ? "" : DAY.format(date) + " ") + CLOCK.format(date);
}

const MINUTE = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
const UTC = /(\d{4}-\d\d-\d\d) (\d\d:\d\d) UTC/g;

// A text of the loop, which says times in UTC, with the times of this page's zone.
export function here(text) {
  return (text ?? "").replace(UTC, (words, day, minute) => {
    const date = new Date(`${day}T${minute}Z`);
    if (Number.isNaN(date.getTime())) return words;
    const today = new Date().toDateString() === date.toDateString();
    return (today ? "" : DAY.format(date) + " ") + MINUTE.format(date);
  });
}

const UNITS = [["d", 86400], ["h", 3600], ["min", 60], ["s", 1]];

// A span in its largest whole unit, or with three digits.
export function duration(seconds) {
  const [name, size] = UNITS.find(([, s]) => seconds >= s) || UNITS[UNITS.length - 1];
  return `${+(seconds / size).toPrecision(3)} ${name}`;
}

export function zone() {
  return ZONE.formatToParts(new Date()).find((part) => part.type === "timeZoneName").value;
}

// Text that is written only when it is new: a screen reader says a live region again at each writing.
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}
