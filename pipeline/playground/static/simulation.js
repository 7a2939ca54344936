// Two controllers on one plant, sample by sample: read, scan, write, and one period of the plant.
import { Loop } from "loopwright/controller";
import { Noise } from "loopwright/noise";

export const LANES = ["A", "B"];
const MOST_ROWS = 20000;
const GONE = 2000; // rows that go at a time
const RECOVER_AFTER = 5; // good samples that end HOLD

export class Simulation {
  constructor(about, plant, controllers) {
    Object.assign(this, { about, plant, controllers, heard: () => {} });
    this.nominal = about.parameters.map((p) => p.value);
    this.chosen = [...about.beside];
    this.seed = 1;
    this.working = Promise.resolve();
  }

  // One thing at a time: a step is not over at once, and a reset must not come into it.
  alone(work) {
    const done = this.working.then(work);
    this.working = done.catch(() => {});
    return done;
  }

  reset(test = this.test ?? this.about.tests[0]) {
    return this.alone(async () => {
      this.test = test;
      this.k = 0;
      this.stopped = "";
      this.sp = this.about.sp.map((_, i) => test.course.find(([k, what, place]) => k === 0 && what === "sp" && place === i)[3]);
      this.dv = [...this.about.dv_nominal];
      this.p = [...this.nominal];
      this.noise = 0; // times the case's own
      this.broken = this.about.pv.map(() => false);
      this.stuck = this.about.mv.map(() => false);
      this.draws = new Noise(this.about.noise_colour, this.seed);
      this.asked = false; // whether a valve ever did something else than it was asked to
      this.next = 0; // place in the test's course
      this.time = [];
      this.columns = {};
      this.lanes = LANES.map((name, i) => ({
        name,
        x: [...test.x0],
        mv: [...test.mv0],
        loop: new Loop(this.controllers[this.chosen[i]], { sp: this.sp, mv: test.mv0, mode: "AUTO", recoverAfter: RECOVER_AFTER }),
        error: 0,
      }));
      await this.#measure();
      this.lanes.forEach((lane) => Object.assign(lane, { measured: [...lane.pv], scan: null }));
    });
  }

  choose(i, name) {
    return this.alone(() => {
      this.chosen[i] = name;
      this.lanes[i].loop.replace(this.controllers[name]);
    });
  }

  setSp(values) {
    for (const { loop } of this.lanes) loop.setSp(values);
    this.sp = [...values];
  }

  // One period. A value set by hand before it holds for all of it.
  step() {
    return this.alone(async () => {
      if (this.stopped) return;
      this.#follow();
      const noise = this.draws.next().map((w, i) => w * this.noise * this.about.noise_std[i]);
      for (const lane of this.lanes) {
        lane.measured = lane.pv.map((v, i) => (this.broken[i] ? NaN : v + noise[i]));
        const before = lane.loop.mode;
        lane.scan = await lane.loop.scan({ pv: lane.measured, dv: this.dv, mv_applied: lane.mv, age_s: 0 });
        lane.mv = lane.scan.mv.map((v, i) => (this.stuck[i] ? lane.mv[i] : v));
        this.asked ||= this.stuck.some(Boolean);
        lane.error += this.sp.reduce((sum, sp, i) => sum + Math.abs(sp - lane.pv[i]), 0) / this.sp.length;
        if (lane.loop.mode !== before) this.heard(lane.name, lane.scan.reason ? `${before} → ${lane.loop.mode}: ${lane.scan.reason}` : `${before} → ${lane.loop.mode}`);
      }
      this.#record(noise);
      const x = await this.plant.step(this.lanes.map((l) => l.x), this.lanes.map((l) => l.mv), this.dv, this.p);
      this.lanes.forEach((lane, i) => (lane.x = x[i]));
      this.k += 1;
      const lost = this.lanes.find((lane) => !lane.x.every(Number.isFinite));
      if (lost) {
        this.stopped = `The plant of ${lost.name} has left what it can compute. Reset, and give disturbances that it can physically meet.`;
        this.heard(lost.name, this.stopped);
        return;
      }
      await this.#measure();
    });
  }

  // The moves of the test at this sample; between them, what was set by hand stays.
  #follow() {
    const course = this.test.course;
    for (; this.next < course.length && course[this.next][0] <= this.k; this.next++) {
      const [, what, place, value] = course[this.next];
      if (what === "sp") this.setSp(this.sp.map((v, i) => (i === place ? value : v)));
      else this[what][place] = value;
      if (this.k) this.heard("test", `${this.about[{ sp: "sp", dv: "dv", p: "parameters" }[what]][place].name} = ${+value.toPrecision(6)}`, true);
    }
  }

  async #measure() {
    const pv = await this.plant.measure(this.lanes.map((lane) => lane.x));
    this.lanes.forEach((lane, i) => (lane.pv = pv[i]));
  }

  #record(noise) {
    const row = {};
    const put = (label, signals, values) => signals.forEach((s, i) => (row[`${label} ${s.name}`] = values[i]));
    const { sp, pv, dv, mv, parameters } = this.about;
    put("sp", sp, this.sp);
    put("dv", dv, this.dv);
    put("p", parameters, this.p);
    put("noise", pv, noise);
    for (const lane of this.lanes) {
      put(`true ${lane.name}`, pv, lane.pv);
      put(`pv ${lane.name}`, pv, lane.measured);
      put(`mv ${lane.name}`, mv, lane.mv);
      put(`asked ${lane.name}`, mv, lane.scan.mv.map((v, i) => (v === lane.mv[i] ? null : v))); // drawn only where it differs
      row[`mode ${lane.name}`] = lane.scan.mode;
      lane.loop.controller.manifest.info.forEach((name, i) => (row[`info ${lane.name} ${name}`] = lane.scan.info ? lane.scan.info[i] : null));
    }
    for (const name of new Set([...Object.keys(row), ...Object.keys(this.columns)])) {
      const column = (this.columns[name] ??= new Array(this.time.length).fill(null));
      column.push(row[name] ?? null);
    }
    this.time.push(this.k * this.about.period_s);
    if (this.time.length <= MOST_ROWS) return;
    for (const column of [this.time, ...Object.values(this.columns)]) column.splice(0, GONE);
  }

  // The newest numbers of some columns from row `from` on, beside their times, as uPlot takes them.
  of(names, from) {
    const nothing = new Array(this.time.length - from).fill(null);
    const seen = (values) => values.slice(from).map((v) => (Number.isNaN(v) ? null : v));
    return [this.time.slice(from), ...names.map((name) => (this.columns[name] ? seen(this.columns[name]) : nothing))];
  }
}
