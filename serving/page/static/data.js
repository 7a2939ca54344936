// The columns that are drawn: a trend from the journal, continued by what comes in live.
import { get } from "./api.js";

const POINTS = 1200;
const MOST_LIVE = 3000; // rows that came in live, after which the trend is thinned anew by the server

export class Data {
  constructor() {
    this.time = [];
    this.columns = {};
    this.modes = [];
    this.live = 0;
    this.asked = 0;
    this.longest = Infinity; // seconds without a scan that are no gap yet
    [this.from, this.to] = [0, 0]; // the time that is known here
  }

  // Replace everything by the trend of a time, and keep the scans that came in while it was made; an answer that a
  // later one overtook is dropped.
  async load(from, to) {
    const asked = ++this.asked;
    const known = this.time.at(-1) ?? -Infinity;
    const found = await get(`/api/trend?from=${from}&to=${to}&points=${POINTS}`);
    if (asked !== this.asked) return false;
    const late = this.after(Math.max(known, found.time.at(-1) ?? -Infinity));
    this.time = found.time;
    this.columns = found.columns;
    this.modes = found.modes;
    [this.from, this.to] = [from, to];
    this.live = 0;
    this.append(late, -Infinity);
    return true;
  }

  // The rows after a time.
  after(time) {
    const first = this.time.findIndex((t) => t > time);
    const from = first < 0 ? this.time.length : first;
    const columns = Object.entries(this.columns).map(([name, values]) => [name, values.slice(from)]);
    return { time: this.time.slice(from), columns: Object.fromEntries(columns) };
  }

  // Scans that came in; true once the trend should be loaded anew.
  append({ time, columns }, oldest) {
    const setBack = time.at(-1) < this.time.at(-1) - this.longest;
    if (setBack) this.forget(time[0]);
    const last = this.time.length ? this.time[this.time.length - 1] : -Infinity;
    const first = time.findIndex((t) => t > last);
    if (first < 0) return false;
    if (time[first] - last > this.longest) this.gap(last, time[first]);
    for (const name of new Set([...Object.keys(this.columns), ...Object.keys(columns)])) {
      const old = this.columns[name] || (this.columns[name] = new Array(this.time.length).fill(null));
      const added = columns[name] ? columns[name].slice(first) : new Array(time.length - first).fill(null);
      old.push(...added);
    }
    this.time.push(...time.slice(first));
    this.live += time.length - first;
    this.to = Math.max(this.to, this.time[this.time.length - 1]);
    let gone = 0;
    while (gone < this.time.length && this.time[gone] < oldest) gone++;
    if (gone > 200) {
      this.time.splice(0, gone);
      for (const values of Object.values(this.columns)) values.splice(0, gone);
    }
    return setBack || this.live > MOST_LIVE;
  }

  // The loop's clock was set back: what it showed from then on lies in no past. The trend has it again in time.
  forget(from) {
    const kept = this.time.findIndex((t) => t >= from);
    if (kept < 0) return;
    this.time.length = kept;
    for (const values of Object.values(this.columns)) values.length = kept;
    this.modes = this.modes.filter(([t]) => t < from);
    this.to = from;
  }

  // Nothing came in for a while: no line is drawn over it, and the mode before it ends.
  gap(last, next) {
    if (last === -Infinity) return;
    this.time.push((last + next) / 2);
    for (const values of Object.values(this.columns)) values.push(null);
    const mode = this.modes[this.modes.length - 1]?.[1];
    if (mode && this.modes[this.modes.length - 1][0] <= last) this.modes.push([last, ""], [next, mode]);
  }

  mode(time, mode) {
    const last = this.modes[this.modes.length - 1];
    if (!last || last[1] !== mode) this.modes.push([time, mode]);
  }

  // The numbers of some columns, beside their times, as uPlot takes them.
  of(names) {
    const nothing = new Array(this.time.length).fill(null);
    return [this.time, ...names.map((name) => this.columns[name] || nothing)];
  }
}
