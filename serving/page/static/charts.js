// Trends, one chart a signal, with one cursor and one time axis for all.
import { ABOVE, bands } from "./bands.js";
import * as courses from "./courses.js";
import * as foresight from "./foresight.js";
import { clock, element, number, unit } from "./format.js";
import * as ranges from "./ranges.js";

const HEIGHT = 184;
const SMALL = 134;
const LABELS = { time: 76, seconds: 66, minutes: 46, value: 20 }; // pixels that a label of an axis needs
const AXIS = { line: 28, lines: 44 }; // pixels below a chart: for times, and for times with days below them
const SYNC = window.uPlot.sync("loop");

// The drawing of a loop: charts with their lines. `kind` says how a line looks.
export function plan(about) {
  const { sp, pv, mv, dv } = about.signals;
  const charts = pv.map((s, i) => ({
    name: s.name,
    signal: s,
    tall: i < sp.length,
    lines: [...(i < sp.length ? [line(`sp ${s.name}`, "SP", "sp")] : []), line(`pv ${s.name}`, "PV", "pv")],
  }));
  for (const s of mv)
    charts.push({
      name: s.name,
      group: "mv",
      signal: s,
      tall: true,
      lines: [
        line(`applied ${s.name}`, "applied", "pv"),
        line(`mv ${s.name}`, "asked", "mv"),
        line(`law ${s.name}`, "law", "law"),
        line(`beside ${s.name}`, "successor", "beside"),
      ],
    });
  for (const s of dv) charts.push({ name: s.name, signal: s, lines: [line(`dv ${s.name}`, "DV", "pv")] });
  for (const name of about.info)
    charts.push({ name, signal: { name, unit: "" }, optional: true, lines: [line(`info ${name}`, name, "pv")] });
  return charts;
}

// How the legend tells the lines apart, beside their colour.
const DASHES = { sp: "dashed", law: "dotted", beside: "dashed" };
const line = (column, label, kind) => ({ column, label, kind });

export class Charts {
  // zoomed(from, to): a time was marked; back(): a double-click.
  constructor(box, { zoomed, back }) {
    this.box = box;
    this.zoomed = zoomed;
    this.back = back;
    this.made = [];
    this.whole = false;
    this.read = null; // the time that the keyboard reads: scans come in, and rows go, meanwhile
    new ResizeObserver(() => this.resize()).observe(box);
  }

  build(charts, data) {
    for (const { plot } of this.made) plot.destroy();
    this.box.replaceChildren();
    this.data = data;
    this.made = charts.map((chart) => {
      const title = element("h3", {}, chart.name, element("span", { class: "unit" }, ` ${unit(chart.signal)}`));
      const box = element("div", { class: "chart", "data-chart": chart.name }, title);
      this.box.append(box);
      return { chart, plot: new window.uPlot(this.options(chart), data.of(chart.lines.map((l) => l.column)), box) };
    });
  }

  // Another time is looked at: reading begins with its newest scan again.
  forget() {
    this.read = null;
  }

  draw(from, to) {
    this.to = to;
    for (const { chart, plot } of this.made) {
      const numbers = this.data.of(chart.lines.map((l) => l.column));
      plot.setData(numbers, false);
      plot.setScale("x", { min: from, max: to });
      plot.root.parentElement.dataset.rows = this.data.time.length; // for tests, which cannot read a canvas
      const rows = plot.root.querySelectorAll(".u-series");
      numbers.forEach((values, i) => i && rows[i].classList.toggle("empty", values.every((v) => v === null)));
      newest(plot);
    }
    if (this.read !== null) queueMicrotask(() => this.point()); // uPlot has its new scales only then
  }

  // The cursor of every chart at the time that is read, or away where that is not shown.
  point() {
    if (this.read === null) return;
    for (const { plot } of this.made) {
      const { min, max } = plot.scales.x;
      const shown = this.read >= min && this.read <= max;
      plot.setCursor(shown ? { left: plot.valToPos(this.read, "x"), top: 1 } : { left: -10, top: -10 }, false);
    }
  }

  // The values one scan further, by the cursor of every chart and in words.
  step(by) {
    const { time } = this.data;
    if (!time.length || !this.made.length) return "";
    const { min, max } = this.made[0].plot.scales.x;
    const [first, last] = [time.findIndex((t) => t >= min), time.findLastIndex((t) => t <= max)];
    if (first < 0 || last < first) return "";
    const row = this.read === null ? last : Math.min(last, Math.max(first, nearest(time, this.read) + by));
    this.read = time[row];
    this.point();
    const said = this.made.map(({ chart }) => {
      const values = chart.lines.map((l) => [l.label, this.data.columns[l.column]?.[row]]).filter(([, v]) => v !== null && v !== undefined);
      return `${chart.name} ${values.map(([label, v]) => `${label} ${number(v, scaled(chart.signal, v))}`).join(", ") || "–"} ${unit(chart.signal)}`.trim();
    });
    return `${clock(time[row])}: ${said.join("; ")}`;
  }

  width() {
    return Math.max(240, this.box.clientWidth);
  }

  resize() {
    for (const { chart, plot } of this.made) plot.setSize({ width: this.width(), height: chart.tall ? HEIGHT : SMALL });
  }

  options(chart) {
    const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
    const axis = { stroke: color("ink-2"), grid: { stroke: color("grid"), width: 1 }, ticks: { stroke: color("grid"), width: 1 } };
    const looks = {
      sp: { stroke: color("sp"), width: 1.5, dash: [6, 4] },
      pv: { stroke: color("pv"), width: 1.5 },
      mv: { stroke: color("mv"), width: 1.5, paths: window.uPlot.paths.stepped({ align: 1 }) },
      law: { stroke: color("law"), width: 1, dash: [2, 3] },
      beside: { stroke: color("beside"), width: 1.5, dash: [8, 3, 2, 3] },
    };
    const value = (_, v) => (v === null || v === undefined ? "–" : number(v, scaled(chart.signal, v)));
    return {
      width: this.width(),
      height: chart.tall ? HEIGHT : SMALL,
      padding: [ABOVE, null, null, null],
      cursor: { sync: { key: SYNC.key, setSeries: false }, drag: { x: true, y: false, setScale: false } },
      legend: { live: true, markers: { dash: (_, i) => DASHES[chart.lines[i - 1]?.kind] || "solid" } },
      scales: { x: { time: true }, y: { range: (_, low, high) => this.range(chart.signal, low, high) } },
      axes: [
        { ...axis, values: times, space: between, size: (_, words) => (words?.some((w) => w.includes("\n")) ? AXIS.lines : AXIS.line) },
        { ...axis, size: 62, space: LABELS.value },
      ],
      series: [
        { value: (_, v) => (v === null || v === undefined ? "–" : clock(v)) },
        ...chart.lines.map((l) => ({ label: l.label, spanGaps: false, points: { show: false }, value, ...looks[l.kind] })),
      ],
      hooks: {
        drawClear: [(u) => bands(u, this.data, color), (u) => ranges.draw(u, chart.signal, color)],
        draw: [(u) => courses.draw(u, chart.signal, foresight.draw(u, chart.signal, chart.group === "mv" ? "mv" : "pv", color), color)],
        setSelect: [(u) => this.selected(u)],
        setCursor: [(u) => (u.cursor.left < 0 ? newest(u) : u.root.classList.add("reading"))],
        ready: [(u) => this.listen(u.over)],
      },
    };
  }

  listen(over) {
    over.addEventListener("dblclick", () => this.back());
    over.addEventListener("pointermove", ({ movementX, movementY }) => {
      if (movementX || movementY) this.forget(); // the cursor is the pointer's from here on
    });
  }

  // The whole range of the signal, or what is there with some air, at least 1 % of the range.
  range(signal, low, high) {
    const known = signal.high !== undefined;
    if (low === null || high === null || (this.whole && known)) return known ? [signal.low, signal.high] : [0, 1];
    if (known) [low, high] = courses.near(signal, ...foresight.near(signal, ...ranges.near(signal, low, high)), this.to);
    const least = known ? 0.01 * (signal.high - signal.low) : 1e-9 + 1e-6 * Math.max(Math.abs(low), Math.abs(high));
    const air = Math.max(0.08 * (high - low), (least - (high - low)) / 2, least / 2);
    return [low - air, high + air];
  }

  selected(u) {
    if (u.select.width < 6) return;
    const [from, to] = [u.select.left, u.select.left + u.select.width].map((x) => u.posToVal(x, "x"));
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    if (to - from > 0.5) this.zoomed(from, to);
  }
}

// The legend tells the newest values that are shown, unless the cursor reads others.
function newest(u) {
  if (u.cursor.left >= 0) return;
  u.root.classList.remove("reading");
  const last = u.data[0].findLastIndex((t) => t <= u.scales.x.max);
  if (last >= 0) u.setLegend({ idx: last }, false);
}

// The row whose time lies nearest.
function nearest(time, at) {
  const next = time.findIndex((t) => t >= at);
  if (next < 0) return time.length - 1;
  return next > 0 && at - time[next - 1] < time[next] - at ? next - 1 : next;
}

// A signal with its range, or a number of the law, which has none.
const scaled = (signal, v) => (signal.high === undefined ? { low: 0, high: Math.abs(v) || 1 } : signal);

// Pixels between two times: on a phone as few as their words need, which are shorter where no seconds are told.
function between(_, axis, from, to, width) {
  if (width > 400) return LABELS.time;
  return (LABELS.minutes * (to - from)) / width > 30 ? LABELS.minutes : LABELS.seconds;
}

// Times of the axis, in 24 hours; the day where it is not today, or another than before.
function times(_, splits, axis, space, step) {
  let day = new Date().toLocaleDateString([], { day: "2-digit", month: "short" });
  return splits.map((t) => {
    const date = new Date(t * 1000);
    const clock = date.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: step < 60 ? "2-digit" : undefined, hourCycle: "h23" });
    const today = date.toLocaleDateString([], { day: "2-digit", month: "short" });
    const first = day !== today;
    day = today;
    return step >= 86400 ? today : first ? `${clock}\n${today}` : clock;
  });
}
