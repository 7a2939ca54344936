// A controller file in JavaScript: the step, and the loop around it, with the limits and refusals of Loopwright's runtime
// (serving/controller.py, loop.py, guard.py). Node, the browser and the playground share this file; it imports nothing,
// and each brings its own onnxruntime as `ort`.

// because: "input" or "output" of a step, else empty.
export class Refused extends Error {
  constructor(words, because = "") {
    super(words);
    this.because = because;
  }
}

const INPUTS = ["sp", "pv", "dv", "mv_applied", "state", "operate", "fresh", "ahead"];
const OUTPUTS = ["mv", "state_next", "info"];
const hex = (bytes) => [...new Uint8Array(bytes)].map((b) => b.toString(16).padStart(2, "0")).join("");
const same = (a, b) => [...a].sort().join() === [...b].sort().join();

const MOVE_ROUNDING = 1e-9; // share of an MV's largest magnitude by which a sum of it and its max_move may be rounded

// Entries that a host acts on. They must stand in the .json too: whoever changed that one would else be shown other ranges.
const ACTED_ON = ["schema", "period_s", "inputs", "n_state", "info", "sp", "pv", "dv", "mv", "operate", "ahead"];

const SWITCHES = ["use", "track", "rest_use"];

// The manifest's entries of `operate`, which operators may change, each by its name, as "y0.low" or "speed".
export class Operate {
  constructor(entries = []) {
    this.entries = entries.map((e) => ({ ...e, name: e.signal ? `${e.signal}.${e.what}` : e.what }));
    this.default = this.entries.map((e) => e.default);
  }

  // `base` (the defaults) with some values by name, {"y0.low": 40}; Refused for an unknown name or a value that is not allowed.
  withValues(values, base = this.default) {
    const found = [...base];
    for (const [name, value] of Object.entries(values)) {
      const i = this.entries.findIndex((e) => e.name === name);
      if (i < 0) throw new Refused(`operate has no entry ${name}; it has ${this.entries.map((e) => e.name).join(", ") || "none"}`, "input");
      found[i] = value;
    }
    return this.checked(found);
  }

  // The values, in the order of the entries; Refused names the first that is outside its engineered range, a switch that is
  // neither 0 nor 1, or a low end above the high one.
  checked(values) {
    if (values?.length !== this.entries.length) throw new Refused(`operate has ${values?.length ?? "no"} values; it needs ${this.entries.length}`, "input");
    this.entries.forEach((e, i) => {
      const value = values[i], binary = SWITCHES.includes(e.what);
      if (typeof value === "number" && e.low <= value && value <= e.high && (!binary || value === 0 || value === 1)) return;
      const allowed = binary && e.low < e.high ? "0 or 1" : `${short(e.low)} to ${short(e.high)} ${e.unit}`.trimEnd();
      throw new Refused(`operate: ${e.name} is ${Number.isFinite(value) ? short(value) : word(value)}; allowed is ${allowed}`, "input");
    });
    this.entries.forEach((e, i) => {
      const above = e.what === "low" ? this.entries.findIndex((other) => other.signal === e.signal && other.what === "high") : i;
      if (values[i] > values[above])
        throw new Refused(`operate: ${e.name} is ${short(values[i])}, above ${this.entries[above].name} = ${short(values[above])}; a low end must not be above the high one`, "input");
    });
    return [...values];
  }
}

export class Controller {
  // `bytes` is the .onnx file, `manifest` the parsed .json beside it; the digest ties one to the other, and the ranges are
  // those of the manifest inside the file. `provider` is "cpu" in Node and "wasm" in a browser.
  static async load(ort, bytes, manifest, provider) {
    const digest = hex(await crypto.subtle.digest("SHA-256", bytes));
    if (digest !== manifest.sha256) throw new Refused(`the file's SHA-256 is ${digest}, its manifest's ${manifest.sha256}`);
    return Controller.undigested(ort, bytes, manifest, provider);
  }

  // The same without the digest, for a page whose browser computes none: over plain HTTP from another machine.
  static async undigested(ort, bytes, manifest, provider) {
    const inside = manifestIn(bytes);
    if (inside.schema !== 1) throw new Refused(`the manifest has schema ${inside.schema}; this host reads 1`);
    const other = ACTED_ON.find((key) => !equal(inside[key], manifest[key]));
    if (other) throw new Refused(`the JSON beside the file has another ${other} than the manifest inside it; get both from one place`);
    const session = await ort.InferenceSession.create(bytes, {
      executionProviders: [provider],
      graphOptimizationLevel: "all",
      executionMode: "sequential",
      intraOpNumThreads: 1,
      interOpNumThreads: 1,
      logSeverityLevel: 4,
    });
    return new Controller(ort, session, { ...manifest, ...inside });
  }

  constructor(ort, session, manifest) {
    Object.assign(this, { session, manifest, buffers: {}, feeds: {}, operate: new Operate(manifest.operate) });
    this.signals = { sp: manifest.sp, pv: manifest.pv, dv: manifest.dv, mv_applied: manifest.mv };
    const sizes = { mv: manifest.mv.length, state_next: manifest.n_state, info: manifest.info.length };
    if (!same(session.inputNames, manifest.inputs) || !same(session.outputNames, OUTPUTS.filter((name) => sizes[name])))
      throw new Refused("the graph has other inputs or outputs than the manifest says");
    const limited = manifest.mv.find((s) => limits(s));
    if (limited && !manifest.inputs.includes("mv_applied"))
      throw new Refused(`the moves of ${limited.name} are limited, but its law does not read mv_applied`);
    for (const name of INPUTS.filter((n) => manifest.inputs.includes(n))) {
      const n = { state: manifest.n_state, operate: this.operate.entries.length, fresh: manifest.pv.length, ahead: this.#coming().length }[name] ?? this.signals[name].length;
      this.buffers[name] = new Float64Array(n);
      this.feeds[name] = new ort.Tensor("float64", this.buffers[name], [n]);
    }
  }

  // State zero means: no past. Also right after any gap.
  cold() {
    return new Float64Array(this.manifest.n_state);
  }

  // One step: {sp, pv, dv, mv_applied, state} -> {mv, state_next, info}; Refused where no MV may be computed or used.
  // Keep state_next for the next step, and the old state after a refusal. One step at a time.
  // `operate` may be given, in the order of its entries (else: the defaults), and `fresh`, 1 for each PV whose reading is
  // new and good, else 0 (else: all are). A PV that is not fresh must be finite all the same. `ahead` are the differences to
  // come of set points and measured disturbances, as the manifest's `ahead` lists them (else: zeros).
  async step(given) {
    for (const [name, buffer] of Object.entries(this.buffers)) {
      const values = name === "ahead" ? this.#known(given) : this.#steered(name, given[name]);
      if (values?.length !== buffer.length) throw new Error(`${name} has ${values?.length} values; it needs ${buffer.length}`);
      const bad = values.findIndex((value) => !Number.isFinite(value));
      if (bad >= 0) {
        const s = this.signals[name]?.[bad];
        const label = s ? `${s.name} [${s.unit}]` : `entry ${bad}`;
        throw new Refused(`${name}: ${label} is ${word(values[bad])}; no MV is computed from a value that is not finite`, "input");
      }
      buffer.set(values);
    }
    const result = await this.session.run(this.feeds);
    const [mv, state_next, info] = OUTPUTS.map((name) => Float64Array.from(result[name]?.data ?? []));
    this.#refuse({ mv, state_next, info });
    return { mv, state_next, info };
  }

  // Zeros, one for each number of `ahead`.
  #coming() {
    const { horizon = 0, signals = [] } = this.manifest.ahead ?? {};
    return new Array(horizon * signals.length).fill(0);
  }

  // `ahead` of a step; Refused where a value to come is out of its range, or a difference is not finite. A present value
  // outside it may stay, and one that is not finite is refused for itself.
  #known({ ahead, sp, dv }) {
    const none = this.#coming();
    if (!ahead) return none;
    if (ahead.length !== none.length) throw new Refused(`ahead has ${ahead.length} values; it needs ${none.length}`, "input");
    const { signals } = this.manifest.ahead, present = [...sp, ...(dv ?? [])];
    Array.from(ahead).forEach((change, k) => {
      const { signal, low, high } = signals[k % signals.length], now = present[k % signals.length];
      const slack = 1e-9 * (high - low), then = now + change;
      if (Number.isFinite(change) && (!Number.isFinite(now) || (then >= Math.min(low, now) - slack && then <= Math.max(high, now) + slack))) return;
      const at = Math.floor(k / signals.length) + 1;
      throw new Refused(`ahead: ${signal} is ${Number.isFinite(then) ? short(then) : word(then)} at sample ${at}; allowed is ${short(low)} to ${short(high)}`, "input");
    });
    return ahead;
  }

  // Defaults where there is none, and what is wrong with a given one.
  #steered(name, values) {
    if (name === "operate") return values ? this.operate.checked(values) : this.operate.default;
    if (name !== "fresh") return values;
    if (!values) return this.manifest.pv.map(() => 1);
    const bad = Array.from(values).findIndex((value) => value !== 0 && value !== 1);
    if (bad >= 0) throw new Refused(`fresh of ${this.manifest.pv[bad]?.name} is ${String(values[bad])}; it is 1 for a new and good reading, or 0`, "input");
    return values;
  }

  #refuse(outputs) {
    for (const [name, values] of Object.entries(outputs)) {
      const bad = values.findIndex((value) => !Number.isFinite(value));
      if (bad >= 0) throw new Refused(`the law gave ${name}[${bad}] = ${word(values[bad])}, which is not finite`, "output");
    }
    for (const [i, s] of this.manifest.mv.entries()) {
      const value = outputs.mv[i];
      if (!(s.low <= value && value <= s.high)) throw new Refused(`the law gave ${s.name} = ${value} ${s.unit}, outside its range [${s.low}, ${s.high}] ${s.unit}`, "output");
      if (s.values && !s.values.includes(value)) throw new Refused(`the law gave ${s.name} = ${value}; it may be one of ${s.values.join(", ")}`, "output");
      if (!limits(s)) continue;
      const applied = this.buffers.mv_applied[i]; // outside the range it counts as its end
      const most = s.max_move + MOVE_ROUNDING * Math.max(Math.abs(s.low), Math.abs(s.high));
      if (!(Math.abs(value - Math.min(Math.max(applied, s.low), s.high)) <= most))
        throw new Refused(`the law gave ${s.name} = ${value} ${s.unit} after ${applied} ${s.unit}; it may move by at most ${s.max_move} ${s.unit} a period`, "output");
    }
  }
}

// The manifest inside a file: an entry of metadata_props, field 14 of ONNX's ModelProto, {key: field 1, value: field 2}.
function manifestIn(bytes) {
  const text = (piece) => new TextDecoder("utf-8", { fatal: true }).decode(piece);
  try {
    const entries = fields(bytesOf(bytes)).filter(([number]) => number === 14).map(([, entry]) => Object.fromEntries(fields(entry)));
    const found = entries.find((entry) => text(entry[1]) === "loopwright.manifest");
    return JSON.parse(text(found[2]));
  } catch {
    throw new Refused("the file holds no manifest");
  }
}

// [number, bytes] of each field of a protobuf message that has a length; the others are passed over.
function fields(message) {
  const found = [];
  let at = 0;
  const varint = () => {
    for (let value = 0, scale = 1; ; scale *= 128) {
      if (at >= message.length || scale > 2 ** 63) throw new Error("cut");
      const byte = message[at++];
      value += (byte & 127) * scale;
      if (byte < 128) return value;
    }
  };
  while (at < message.length) {
    const tag = varint(), kind = tag % 8;
    if (kind === 0) varint();
    else if (kind === 2) {
      const end = varint() + at;
      if (end > message.length) throw new Error("cut");
      found.push([Math.floor(tag / 8), message.subarray(at, end)]);
      at = end;
    } else if (kind === 1 || kind === 5) at += kind === 1 ? 8 : 4;
    else throw new Error("no message");
  }
  return found;
}

const bytesOf = (given) => (ArrayBuffer.isView(given) ? new Uint8Array(given.buffer, given.byteOffset, given.byteLength) : new Uint8Array(given));

// Whether two values of JSON say the same; the order of an object's entries says nothing.
function equal(a, b) {
  if (a === null || b === null || typeof a !== "object" || typeof b !== "object") return a === b;
  const keys = Object.keys(a);
  return Array.isArray(a) === Array.isArray(b) && keys.length === Object.keys(b).length &&
    keys.every((key) => Object.hasOwn(b, key) && equal(a[key], b[key]));
}

// Whether an MV's moves are limited. A discrete one has no way between its values.
const limits = (s) => Boolean(s.max_move && !s.values);

const PV_MARGIN = 0.05; // share of a PV's range beyond which the sensor is broken
const READ_BACK_MARGIN = 0.02; // share of an MV's range by which scaling may carry a sound read-back over its ends
const DIGITS = 6;
const BRIDGE_PERIODS = 10; // a law's own prediction is as good as its model, and loads go on unseen meanwhile
const UNKNOWN = "there is no read-back, so where the MV stands is not known and nothing is written";

// Bad readings of single PVs. A law that reads `fresh` goes on without a PV whose reading is bad: for bridgeS seconds it predicts
// the PV, then the PV is shed: its `use` is 0 for the law until the reading is good again. The sample is refused where no
// PV is left that the operator has in use, and where a PV is gone for longer that is critical or has no `use`.
class Bridging {
  constructor(manifest, bridgeS, critical) {
    Object.assign(this, { m: manifest, bridgeS: bridgeS ?? BRIDGE_PERIODS * manifest.period_s, critical });
    this.last = manifest.pv.map(() => NaN); // the last good number of each PV
    this.gone = manifest.pv.map(() => 0); // periods since then, the present one included
    const uses = (manifest.operate ?? []).map((e, i) => [e, i]).filter(([e]) => e.group === "cv" && e.what === "use");
    this.useOf = new Map(uses.map(([e, i]) => [e.signal, i]));
  }

  missed(periods = 1) {
    this.gone = this.gone.map((n) => n + periods);
  }

  // {reason} of a refusal, or {pv, fresh, operate, bridged, shed}: what the law gets, and why a PV's reading is not used.
  // `bad` says for each PV why its reading is bad, or is empty.
  look({ pv, fresh }, bad, operate) {
    this.last = this.last.map((value, i) => (bad[i] ? value : pv[i]));
    this.gone = this.gone.map((n, i) => (bad[i] ? n + 1 : 0));
    const bridged = {}, shed = {}, used = [...operate];
    for (const [i, s] of this.m.pv.entries()) {
      if (!bad[i]) continue;
      if (Number.isNaN(this.last[i])) return { reason: `${bad[i]}; it has not been read yet` };
      if ((this.gone[i] - 1) * this.m.period_s < this.bridgeS) bridged[s.name] = bad[i];
      else if (this.critical.includes(s.name)) return { reason: `${bad[i]}; the loop needs this PV` };
      else if (!this.useOf.has(s.name)) return { reason: `${bad[i]}; the law cannot leave this PV out` };
      else (shed[s.name] = bad[i]), (used[this.useOf.get(s.name)] = 0);
    }
    const wanted = [...this.useOf].filter(([, i]) => operate[i] > 0);
    if (Object.keys(shed).length && wanted.length && wanted.every(([name]) => name in shed))
      return { reason: `${Object.values(shed)[0]}; no controlled variable is left` };
    return {
      reason: "", bridged, shed, operate: used,
      pv: pv.map((value, i) => (bad[i] ? this.last[i] : value)),
      fresh: this.m.pv.map((_, i) => (bad[i] ? 0 : fresh?.[i] ?? 1)),
    };
  }
}

export class Loop {
  // mode: MANUAL the operator's MV, AUTO the law's, HOLD the last one after a fault, SHADOW others': nothing is written. `sp` and `mv` lie in their ranges.
  // `mv` is what the plant has now; null: not known, so nothing is written until a good sample has a read-back.
  // recoverAfter: good samples after which HOLD returns to AUTO; null: only the operator returns it.
  // bridgeS, critical: seconds for which the bad reading of a PV is bridged (ten periods), and names of PVs without which the
  // loop holds after that; of a law that reads `fresh`.
  constructor(controller, { sp, mv = null, mode = "MANUAL", recoverAfter = null, maxGap = 3, bridgeS = null, critical = [] }) {
    Object.assign(this, { controller, mode, recoverAfter, maxGap, fault: "", good: 0, state: controller.cold() });
    this.bridging = new Bridging(controller.manifest, bridgeS, critical);
    this.lost = false; // the last command did not reach the plant, and nothing has told since where the MV stands
    this.taken = false; // others had the MV until now, and nothing has told since where it stands
    this.sp = within(sp, controller.manifest.sp, "set point");
    this.mv = this.before = mv && within(mv, controller.manifest.mv, "MV");
    this.operate = controller.operate.default; // see setOperate
    this.ahead = null; // set it before a scan: what is to come, as of Controller.step; null: nothing
    this.wishes = {}; // the values that somebody has set, by name; they outlast a law that lacks them
    this.wanted = null; // where an operator sent the MV: it goes there by at most its max_move a period
    this.hand = false; // the MV of the last scan is an operator's, in MANUAL since then
    this.isRead = false; // a sample has had a read-back, sound or not
  }

  setMode(mode) {
    if (mode !== this.mode) Object.assign(this, { wanted: null, hand: false });
    this.taken = mode !== "SHADOW" && (this.taken || this.mode === "SHADOW");
    Object.assign(this, { mode, fault: "", good: 0 });
  }

  setSp(sp) {
    this.sp = within(sp, this.controller.manifest.sp, "set point");
  }

  // Values of `operate` by name, {"y0.low": 40, "y0.high": 60}; Refused, and nothing changed, where one is not allowed.
  setOperate(values) {
    this.operate = this.controller.operate.withValues(values, this.operate);
    Object.assign(this.wishes, values);
  }

  setMv(mv) {
    if (this.mode !== "MANUAL") throw new Refused(`the MV is set by hand in MANUAL only; the loop is in ${this.mode}`);
    if (this.lost) throw new Refused("the last MV did not reach the plant, so where the MV stands is not known; wait");
    this.#send(within(mv, this.controller.manifest.mv, "MV"), this.taken || !this.mv);
    this.hand = true;
  }

  // Begin the way to where an operator wants the MV. One whose moves are not limited is there, unless all wait for a scan that
  // tells where they stand: from a read-back, or at once where there is none; a bad one ends the way.
  #send(wanted, wait) {
    const signals = this.controller.manifest.mv;
    this.wanted = wait || signals.some(limits) ? wanted : null;
    if (!wait) this.mv = signals.map((s, i) => (limits(s) ? this.mv[i] : wanted[i]));
  }

  // Another controller takes over; it has no past. It has by name what somebody has set of `operate`, and its own defaults for
  // the rest; Refused, and nothing changed, where a value is outside its range.
  replace(controller) {
    const known = controller.operate.entries.map((e) => e.name);
    const set = Object.entries(this.wishes).filter(([name]) => known.includes(name));
    const operate = controller.operate.withValues(Object.fromEntries(set));
    Object.assign(this, { controller, state: controller.cold(), operate, ahead: null });
    this.bridging = new Bridging(controller.manifest, this.bridging.bridgeS, this.bridging.critical);
  }

  // So many periods passed without a scan: after more than maxGap the law starts cold.
  gap(periods) {
    this.bridging.missed(periods);
    if (periods > this.maxGap) this.state = this.controller.cold();
  }

  // One period. sample: {pv, dv, mv_applied or null, age_s, and fresh where not all readings are}, or null where the plant could not be read. Nothing that it
  // holds throws. -> {mode, mv, law, info, reason}; mv is null in SHADOW, and while it is not known where the MV stands: then write nothing.
  // Where the readings of single PVs are bad and the law goes on, `bridged` and `shed` say of which, and why.
  async scan(sample) {
    let given = null, reason = "the plant cannot be read", readings = null;
    try {
      given = taken(sample);
      const bad = this.controller.manifest.inputs.includes("fresh") ? this.controller.manifest.pv.map(() => "") : null;
      if (given) reason = this.#refusal(given, bad);
      if (!reason && bad) readings = this.bridging.look(given, bad, this.operate);
    } catch (error) {
      reason = `the sample cannot be used: ${wordsOf(error)}`;
    }
    if (reason) this.bridging.missed();
    reason ||= readings?.reason ?? "";
    this.#found(given, reason);
    this.before = this.mv;
    if (!given?.mv_applied && !this.lost && !this.taken && (!reason || !this.isRead)) this.mv ??= this.wanted; // nobody but the operator says where it is
    if (!reason && !given.mv_applied && !this.mv) reason = UNKNOWN;
    if (reason) return this.#held(reason);
    const applied = given.mv_applied ? this.#clipped(given.mv_applied) : this.mv;
    if (!this.mv || this.mode === "SHADOW") this.mv = applied;
    let step;
    try {
      const { pv, fresh, operate } = readings ?? { pv: given.pv, operate: this.operate };
      step = await this.controller.step({ sp: this.sp, pv, dv: given.dv, mv_applied: applied, state: this.state, operate, fresh, ahead: this.ahead });
    } catch (error) {
      if (this.mode === "AUTO") this.mv = applied;
      return this.#held(wordsOf(error));
    }
    this.state = step.state_next;
    if (this.fault && ++this.good === this.recoverAfter) this.setMode("AUTO");
    if (this.mode === "AUTO") this.mv = Array.from(step.mv);
    this.#byHand();
    this.hand = this.mode === "MANUAL";
    const { bridged = {}, shed = {} } = readings ?? {};
    return { mode: this.mode, mv: this.#written(), law: Array.from(step.mv), info: Array.from(step.info), reason: this.fault, bridged, shed };
  }

  // The command in place of the last one, which never reached the plant. Others may move the MV meanwhile: nothing is
  // written until a scan has found where it stands.
  unwritten(reason) {
    const goal = this.wanted ?? this.mv;
    this.mv = this.before;
    if (this.hand && goal) this.#send(goal, !this.mv); // where it should be is where it goes, from where it stands
    this.lost = true;
    return this.#miss(reason);
  }

  // Where the MV stands after a command that did not arrive, and after others had it: at the next sound read-back, also that
  // of a sample which is refused for another reason. A good sample without one says that nothing is read back: the MV before
  // it stays, also at once where there has never been a read-back. After a bad one the old MV is nothing to go back to.
  #found(given, reason) {
    const applied = given?.mv_applied, sound = applied && !this.#implausible(applied);
    const blind = this.wanted && !this.mv; // on a way by hand from nobody knows where
    this.isRead ||= Boolean(applied);
    if (!(this.lost || this.taken || blind) || (!applied && reason && this.isRead)) return;
    if (applied && (this.lost || !sound)) this.wanted = null; // it stays where it is found
    if (applied) this.mv = sound ? this.#clipped(applied) : null;
    this.lost &&= Boolean(applied && !sound);
    this.taken &&= Boolean(applied && !sound);
  }

  // The MV that is to be written, else null.
  #written() {
    return this.lost || this.taken || this.mode === "SHADOW" ? null : this.mv && [...this.mv];
  }

  // No past any more. In AUTO a fault: the MV is held until recoverAfter good samples, or until the operator acts.
  #miss(reason) {
    Object.assign(this, { state: this.controller.cold(), good: 0 });
    if (this.mode === "AUTO" || this.fault) Object.assign(this, { mode: "HOLD", fault: reason });
    if (!this.lost && !this.taken) this.#byHand();
    return { mode: this.mode, mv: this.#written(), law: null, info: null, reason };
  }

  // The end of a scan without an MV of the law.
  #held(reason) {
    const command = this.#miss(reason);
    this.hand = this.mode === "MANUAL";
    return command;
  }

  // One period nearer to where an operator sent the MV.
  #byHand() {
    if (!this.wanted || !this.mv) return;
    const wanted = this.wanted;
    this.mv = this.controller.manifest.mv.map((s, i) => {
      const way = wanted[i] - this.mv[i];
      if (!limits(s) || !(Math.abs(way) > s.max_move)) return wanted[i];
      return Math.min(Math.max(this.mv[i] + Math.sign(way) * s.max_move, s.low), s.high);
    });
    if (this.mv.every((value, i) => value === wanted[i])) this.wanted = null;
  }

  // Why not to act on a sample, else empty. `bad` (of a law that reads `fresh`) takes what speaks against single PVs alone.
  #refusal({ pv, dv, mv_applied, fresh, age_s }, bad) {
    const m = this.controller.manifest;
    if (bad && fresh && fresh.length !== m.pv.length) return `fresh has ${fresh.length} values instead of ${m.pv.length}`;
    if (bad && pv?.length === m.pv.length)
      m.pv.forEach((s, i) => {
        bad[i] = notFinite("PV", [s], [pv[i]]) || (beyond(s, pv[i], PV_MARGIN) ? `PV ${outside(s, pv[i])}` : "");
      });
    const vectors = [...(bad && pv?.length === m.pv.length ? [] : [["PV", m.pv, pv]]), ...(m.inputs.includes("dv") ? [["DV", m.dv, dv]] : [])];
    const reason = vectors.map((vector) => notFinite(...vector)).find(Boolean) ?? (mv_applied ? this.#implausible(mv_applied) : "");
    if (reason) return reason;
    const out = bad ? -1 : m.pv.findIndex((s, i) => beyond(s, pv[i], PV_MARGIN));
    if (out >= 0) return `PV ${outside(m.pv[out], pv[out])}`;
    return age_s >= 0 && age_s <= m.period_s ? "" : `the sample is ${age_s} s old; allowed are ${m.period_s} s`;
  }

  // Why no actuator can have this MV, else empty.
  #implausible(applied) {
    const signals = this.controller.manifest.mv;
    const reason = notFinite("applied MV", signals, applied);
    if (reason) return reason;
    for (const [i, s] of signals.entries()) {
      if (s.values && !s.values.includes(applied[i])) return `applied MV ${s.name} is ${short(applied[i])}, none of ${s.values.join(", ")}`;
      if (!s.values && beyond(s, applied[i], READ_BACK_MARGIN)) return `applied MV ${outside(s, applied[i])}`;
    }
    return "";
  }

  #clipped(applied) {
    return this.controller.manifest.mv.map((s, i) => Math.min(Math.max(applied[i], s.low), s.high));
  }
}

// The values, where each lies in its signal's range; Refused says what is allowed.
export function within(values, signals, what) {
  if (values.length !== signals.length) throw new Refused(`the ${what} has ${values.length} values; it needs ${signals.length}`);
  signals.forEach((s, i) => {
    const value = values[i];
    const unit = s.unit === "-" ? "" : ` ${s.unit}`;
    if (!Number.isFinite(value)) throw new Refused(`the ${what} ${s.name} is no finite number; give one from ${short(s.low)} to ${short(s.high)}${unit}`);
    if (s.values && !s.values.includes(value)) throw new Refused(`the ${what} ${s.name} = ${short(value)} is none of ${s.values.join(", ")}`);
    if (!(s.low <= value && value <= s.high)) throw new Refused(`the ${what} ${s.name} = ${value}${unit} is outside [${short(s.low)}, ${short(s.high)}]${unit}`);
  });
  return [...values];
}

// A copy of a sample, with null for what is not there; null for no sample.
function taken(sample) {
  if (sample === null || sample === undefined) return null;
  const { pv = null, dv = null, mv_applied = null, fresh = null, age_s } = sample;
  const copied = (values) => (values === null ? null : Array.from(values));
  return { pv: copied(pv), dv: copied(dv), mv_applied: copied(mv_applied), fresh: copied(fresh), age_s };
}

function notFinite(label, signals, values) {
  if (values?.length !== signals.length) return `${label} has ${values?.length ?? "no"} values instead of ${signals.length}`;
  const bad = signals.findIndex((_, i) => !Number.isFinite(values[i]));
  return bad >= 0 ? `${label} ${signals[bad].name} is ${word(values[bad])}` : "";
}

// The words of an error; anything may be thrown.
export function wordsOf(error) {
  try {
    return String(error?.message ?? error);
  } catch {
    return "an error without words";
  }
}

const beyond = (s, value, margin) => value < s.low - margin * (s.high - s.low) || value > s.high + margin * (s.high - s.low);
const outside = (s, value) => `${s.name} is ${short(value)} ${s.unit}, outside its range [${short(s.low)}, ${short(s.high)}] ${s.unit}`;
const short = (value) => String(+value.toPrecision(DIGITS));
// A value that is not finite, as the runtime writes it.
const word = (value) => (typeof value === "number" ? (Number.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf") : "no number");
