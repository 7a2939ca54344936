// A controller file in JavaScript: the step, and the loop around it with limits and refusals as Loopwright's runtime has.
// Node and the browser share this file; each brings its own onnxruntime as `ort`.

export class Refused extends Error {
  constructor(because, words) {
    super(words);
    this.because = because; // "input" or "output"
  }
}

const hex = (bytes) => [...new Uint8Array(bytes)].map((b) => b.toString(16).padStart(2, "0")).join("");
const middle = (s) => {
  const at = (s.low + s.high) / 2;
  return s.values ? s.values.reduce((a, b) => (Math.abs(b - at) < Math.abs(a - at) ? b : a)) : at;
};

export class Controller {
  // `bytes` is the .onnx file, `manifest` the parsed .json beside it. The digest ties one to the other.
  // `provider` is "cpu" in Node and "wasm" in a browser.
  static async load(ort, bytes, manifest, provider) {
    if (manifest.schema !== 1) throw new Error(`the manifest has schema ${manifest.schema}; this host reads 1`);
    const digest = hex(await crypto.subtle.digest("SHA-256", bytes));
    if (digest !== manifest.sha256) throw new Error(`the file's SHA-256 is ${digest}, its manifest's ${manifest.sha256}`);
    const session = await ort.InferenceSession.create(bytes, {
      executionProviders: [provider],
      graphOptimizationLevel: "all",
      executionMode: "sequential",
      intraOpNumThreads: 1,
      interOpNumThreads: 1,
    });
    return new Controller(ort, session, manifest);
  }

  constructor(ort, session, manifest) {
    this.manifest = manifest;
    this.session = session;
    this.signals = { sp: manifest.sp, pv: manifest.pv, dv: manifest.dv, mv_applied: manifest.mv };
    const outputs = { mv: manifest.mv.length, state_next: manifest.n_state, info: manifest.info.length };
    const same = (a, b) => [...a].sort().join() === [...b].sort().join();
    if (!same(session.inputNames, manifest.inputs) || !same(session.outputNames, Object.keys(outputs).filter((n) => outputs[n])))
      throw new Error("the graph has other inputs or outputs than the manifest says");
    this.buffers = {};
    this.feeds = {};
    for (const name of manifest.inputs) {
      const n = name === "state" ? manifest.n_state : this.signals[name].length;
      this.buffers[name] = new Float64Array(n);
      this.feeds[name] = new ort.Tensor("float64", this.buffers[name], [n]);
    }
    this.cold();
  }

  // State zero means: no past. Also right after any gap.
  cold() {
    this.state = new Float64Array(this.manifest.n_state);
  }

  // One step: {sp, pv, dv, mv_applied} -> {mv, info}. It throws Refused and keeps its state where no MV may be used.
  async step(given) {
    for (const name of this.manifest.inputs) {
      const values = name === "state" ? this.state : given[name];
      if (values?.length !== this.buffers[name].length)
        throw new Error(`${name} has ${values?.length} values; it needs ${this.buffers[name].length}`);
      const bad = values.findIndex((value) => !Number.isFinite(value));
      if (bad >= 0) throw new Refused("input", `${name}[${bad}] is ${values[bad]}; no MV is computed from it`);
      this.buffers[name].set(values);
    }
    const result = await this.session.run(this.feeds);
    const none = new Float64Array(0);
    const [mv, state, info] = ["mv", "state_next", "info"].map((name) => result[name]?.data ?? none);
    for (const values of [mv, state, info])
      if (!values.every(Number.isFinite)) throw new Refused("output", "the law gave a value that is not finite");
    this.manifest.mv.forEach((s, i) => {
      if (!(s.low <= mv[i] && mv[i] <= s.high) || (s.values && !s.values.includes(mv[i])))
        throw new Refused("output", `the law gave ${s.name} = ${mv[i]} ${s.unit}, which it may not have`);
    });
    this.state = Float64Array.from(state);
    return { mv: Float64Array.from(mv), state_next: this.state, info: Float64Array.from(info) };
  }
}

const PV_MARGIN = 0.05; // share of a PV's range beyond which the sensor is broken
const READ_BACK_MARGIN = 0.02; // share of an MV's range by which scaling may carry a sound read-back over its ends

export class Loop {
  // mode: MANUAL the operator's MV, AUTO the law's, HOLD the last one after a fault. `sp` and `mv` lie in their ranges.
  // `mv` is what the plant has now; null: not known, so nothing is written until a good sample has a read-back.
  constructor(controller, { sp, mv = null, mode = "MANUAL", recoverAfter = null, maxGap = 3 }) {
    Object.assign(this, { controller, mode, recoverAfter, maxGap, fault: "", good: 0 });
    this.sp = this.#within(sp, controller.manifest.sp, "set point");
    this.mv = mv && this.#within(mv, controller.manifest.mv, "MV");
  }

  setMode(mode) {
    Object.assign(this, { mode, fault: "", good: 0 });
  }

  setSp(sp) {
    this.sp = this.#within(sp, this.controller.manifest.sp, "set point");
  }

  // So many periods passed without a scan: after more than maxGap the law starts cold.
  gap(periods) {
    if (periods > this.maxGap) this.controller.cold();
  }

  // One period. sample: {pv, dv, mv_applied or null, age_s}, or null where the plant could not be read.
  // The command's mv is null while it is not known where the MV stands: then write nothing.
  async scan(sample) {
    let reason = sample === null ? "the plant cannot be read" : this.#refusal(sample);
    if (!reason) {
      const applied = sample.mv_applied === null ? this.mv : this.#clipped(sample.mv_applied);
      this.mv ??= applied;
      try {
        const { mv } = await this.controller.step({ sp: this.sp, pv: sample.pv, dv: sample.dv, mv_applied: applied });
        if (this.fault && ++this.good === this.recoverAfter) this.setMode("AUTO");
        if (this.mode === "AUTO") this.mv = mv;
        return { mode: this.mode, mv: this.mv, reason: this.fault };
      } catch (error) {
        if (this.mode === "AUTO") this.mv = applied;
        reason = error.message;
      }
    }
    return this.#failed(reason);
  }

  // The command in place of the last one, which never reached the plant: the MV before it stays.
  unwritten(before, reason) {
    if (this.mode !== "MANUAL") this.mv = before;
    return this.#failed(reason);
  }

  // A fault: no past any more. In AUTO the MV is held until recoverAfter good samples, or until the operator acts.
  #failed(reason) {
    this.controller.cold();
    this.good = 0;
    if (this.mode === "AUTO" || this.fault) [this.mode, this.fault] = ["HOLD", reason];
    return { mode: this.mode, mv: this.mv, reason };
  }

  #refusal({ pv, dv, mv_applied, age_s }) {
    const m = this.controller.manifest;
    const vectors = [["PV", m.pv, pv], ["applied MV", m.mv, mv_applied]];
    if (m.inputs.includes("dv")) vectors.push(["DV", m.dv, dv]);
    for (const [label, signals, values] of vectors) {
      if (values === null && signals === m.mv) continue;
      if (values?.length !== signals.length) return `${label} has ${values?.length} values instead of ${signals.length}`;
      const bad = signals.findIndex((s, i) => !Number.isFinite(values[i]));
      if (bad >= 0) return `${label} ${signals[bad].name} is ${values[bad]}`;
    }
    if (!mv_applied && !this.mv)
      return "there is no read-back, so where the MV stands is not known and nothing is written";
    for (const [i, s] of m.mv.entries())
      if (mv_applied && (s.values ? !s.values.includes(mv_applied[i]) : beyond(s, mv_applied[i], READ_BACK_MARGIN)))
        return `applied MV ${s.name} is ${mv_applied[i]} ${s.unit}, which no actuator can hold`;
    for (const [i, s] of m.pv.entries())
      if (beyond(s, pv[i], PV_MARGIN)) return `PV ${s.name} is ${pv[i]} ${s.unit}, outside its range`;
    if (!(age_s >= 0 && age_s <= m.period_s)) return `the sample is ${age_s} s old; allowed are ${m.period_s} s`;
    return "";
  }

  #clipped(applied) {
    return Float64Array.from(this.controller.manifest.mv, (s, i) => Math.min(Math.max(applied[i], s.low), s.high));
  }

  #within(values, signals, what) {
    const wrong = signals.findIndex(
      (s, i) => !(values[i] >= s.low && values[i] <= s.high) || (s.values && !s.values.includes(values[i]))
    );
    if (values.length !== signals.length || wrong >= 0) throw new Error(`the ${what} ${[...values]} is not allowed`);
    return Float64Array.from(values);
  }
}

const beyond = (s, value, margin) => {
  const slack = margin * (s.high - s.low);
  return !(s.low - slack <= value && value <= s.high + slack);
};

// Scan once a period at start + k period: lateness never becomes drift, and a period that has passed whole is skipped.
// now() gives seconds that only grow, sleep(seconds) a promise, plant {read(), write(mv)}, seen(command) gets each command.
export async function run(loop, plant, { scans, now, sleep, period = loop.controller.manifest.period_s, seen = () => {} }) {
  const start = now();
  for (let k = 0; k < scans; k++) {
    // A timer may fire early.
    for (let wait; (wait = start + k * period - now()) > 0; ) await sleep(wait);
    let late = now() - (start + k * period);
    const missed = Math.floor(Math.max(0, late) / period);
    if (missed) {
      loop.gap(missed);
      k += missed;
      late -= missed * period;
    }
    let sample = null;
    const before = loop.mv;
    try {
      sample = await plant.read();
    } catch {
      // the loop holds the MV and names the fault
    }
    let command = await loop.scan(sample);
    try {
      if (command.mv) await plant.write(command.mv);
    } catch (error) {
      command = loop.unwritten(before, `the plant cannot be written: ${error.message}`);
    }
    seen({ k, late, ...command });
  }
}

// Stands for your plant until you read yours: the PVs wander over their ranges, the MV is read back as it was written.
export class MadeUpPlant {
  constructor(manifest) {
    Object.assign(this, { m: manifest, mv: manifest.mv.map(middle), k: 0 }); // where its actuators stand
  }

  read() {
    const at = (this.k++ % 10) / 10;
    const pv = this.m.pv.map((s) => s.low + (s.high - s.low) * at);
    return { pv, dv: this.m.dv.map(middle), mv_applied: [...this.mv], age_s: 0 };
  }

  write(mv) {
    this.mv = mv;
  }
}

// Set points to begin with; give those of your plant.
export const start = (manifest) => ({ sp: manifest.sp.map(middle) });
