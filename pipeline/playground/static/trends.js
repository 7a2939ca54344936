// Trends of both controllers: one chart a signal, one cursor and one time axis for all.
import { element, number, unit } from "loopwright/format";

const TALL = 175;
const SMALL = 145;
const LABELS = { time: 80, value: 20 }; // pixels that a label of an axis needs
const STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 21600, 43200, 86400]; // of the time axis [s]
const DASHES = { sp: "dashed", B: "dashed", asked: "dotted" };

// The charts of a case. `optional` ones are drawn once they are asked for, or once their parameter was moved.
// `asked`: whether a valve ever did something else than it was asked to.
export function plan(about, infos, asked) {
  const both = (kind, name) => ["A", "B"].map((lane) => ({ column: `${kind} ${lane} ${name}`, label: lane, kind: lane }));
  const wish = (name) => asked ? ["A", "B"].map((lane) => ({ column: `asked ${lane} ${name}`, label: `${lane} asks`, kind: "asked" })) : [];
  const one = (column, label) => [{ column, label, kind: "given" }];
  return [
    ...about.pv.map((s, i) => ({ name: s.name, signal: s, tall: i < about.sp.length, lines: [...(i < about.sp.length ? [{ column: `sp ${about.sp[i].name}`, label: "SP", kind: "sp" }] : []), ...both("pv", s.name)] })),
    ...about.mv.map((s) => ({ name: s.name, signal: s, tall: true, stepped: true, lines: [...both("mv", s.name), ...wish(s.name)] })),
    ...about.dv.map((s) => ({ name: s.name, signal: s, stepped: true, lines: one(`dv ${s.name}`, "DV") })),
    ...about.parameters.map((p) => ({ name: p.name, signal: p, stepped: true, optional: "parameter", lines: one(`p ${p.name}`, "value") })),
    ...infos.map((name) => ({ name, signal: { name, unit: "" }, stepped: true, optional: "law", lines: both("info", name) })),
  ];
}

export class Trends {
  constructor(box, simulation) {
    Object.assign(this, { box, simulation, made: [], whole: false });
    new ResizeObserver(() => this.resize()).observe(box);
  }

  build(charts) {
    for (const { plot } of this.made) plot.destroy();
    this.box.replaceChildren();
    this.made = charts.map((chart) => {
      const title = element("h3", {}, chart.name, element("span", { class: "unit" }, ` ${unit(chart.signal)}`));
      const box = element("div", { class: "chart", "data-chart": chart.name }, title);
      this.box.append(box);
      return { chart, plot: new window.uPlot(this.options(chart), [[], ...chart.lines.map(() => [])], box) };
    });
  }

  // The last `samples`; Infinity: all.
  draw(samples) {
    const { time, about } = this.simulation;
    const from = Math.max(0, time.length - samples);
    const shown = Number.isFinite(samples) ? samples : Math.max(time.length, 100);
    const first = time[from] ?? 0;
    for (const { chart, plot } of this.made) {
      plot.setData(this.simulation.of(chart.lines.map((l) => l.column), from), false);
      plot.setScale("x", { min: first, max: first + (shown - 1) * about.period_s });
      plot.root.parentElement.dataset.rows = time.length; // for tests, which cannot read a canvas
    }
  }

  width() {
    return Math.max(260, this.box.clientWidth);
  }

  resize() {
    for (const { chart, plot } of this.made) plot.setSize({ width: this.width(), height: chart.tall ? TALL : SMALL });
  }

  options(chart) {
    const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
    const axis = { stroke: color("ink-2"), grid: { stroke: color("grid"), width: 1 }, ticks: { stroke: color("grid"), width: 1 } };
    const looks = {
      sp: { stroke: color("sp"), width: 1.5, dash: [6, 4], paths: window.uPlot.paths.stepped({ align: 1 }) },
      A: { stroke: color("pv"), width: 1.6 },
      B: { stroke: color("beside"), width: 1.6, dash: [8, 3, 2, 3] },
      asked: { stroke: color("law"), width: 1, dash: [2, 3] },
      given: { stroke: color("mv"), width: 1.5 },
    };
    const paths = chart.stepped ? { paths: window.uPlot.paths.stepped({ align: 1 }) } : {};
    const value = (_, v) => (v === null || v === undefined ? "–" : number(v, chart.signal.high === undefined ? null : chart.signal));
    return {
      width: this.width(),
      height: chart.tall ? TALL : SMALL,
      cursor: { sync: { key: "playground", setSeries: false }, drag: { x: true, y: false } },
      legend: { live: true, markers: { dash: (_, i) => DASHES[chart.lines[i - 1]?.kind] || "solid" } },
      scales: { x: { time: false }, y: { range: (_, low, high) => this.range(chart.signal, low, high) } },
      axes: [
        { ...axis, values: (_, splits) => durations(splits), incrs: STEPS, space: LABELS.time },
        { ...axis, size: 62, space: LABELS.value },
      ],
      series: [
        { label: "time", value: (_, v) => (v === null || v === undefined ? "–" : duration(v)) },
        ...chart.lines.map((l) => ({ label: l.label, spanGaps: false, points: { show: false }, value, ...looks[l.kind], ...paths })),
      ],
    };
  }

  // The whole range of the signal, or what is there with some air, at least 1 % of the range.
  range(signal, low, high) {
    const known = signal.high !== undefined;
    if (low === null || high === null || (this.whole && known)) return known ? [signal.low, signal.high] : [0, 1];
    const least = known ? 0.01 * (signal.high - signal.low) : 1e-9 + 1e-6 * Math.max(Math.abs(low), Math.abs(high));
    const air = Math.max(0.08 * (high - low), (least - (high - low)) / 2, least / 2);
    return [low - air, high + air];
  }
}

// Times of the axis in one unit, chosen by the last of them.
function durations(splits) {
  const last = splits.at(-1) ?? 0;
  const [size, name] = last > 3 * 3600 ? [3600, "h"] : last > 300 ? [60, "min"] : [1, "s"];
  return splits.map((t) => `${+(t / size).toPrecision(6)} ${name}`);
}

// Hours, minutes and seconds of the plant's time.
export function duration(seconds) {
  const whole = Math.floor(seconds + 1e-9);
  const parts = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60].map((n) => String(n).padStart(2, "0"));
  const rest = Math.round((seconds - whole) * 10);
  return parts.join(":") + (rest > 0 && rest < 10 ? `.${rest}` : "");
}
