// The loop around a controller: modes, guards and faults as the runtime has them (serving/loop.py, serving/guard.py).
import { Refused, word } from "loopwright/controller";

const PV_MARGIN = 0.05; // share of a PV's range beyond which its sensor is taken for broken
const READ_BACK_MARGIN = 0.02; // share of an MV's range by which scaling may carry a sound read-back over its ends
const DIGITS = 6;

export class Loop {
  // MANUAL: the operator's MV. AUTO: the law's. HOLD: the last one, after a fault; so many good samples end it.
  constructor(controller, { sp, mv, mode = "AUTO", recoverAfter = 5 }) {
    Object.assign(this, { controller, mode, recoverAfter, fault: "", good: 0, state: controller.cold() });
    this.sp = within(sp, controller.manifest.sp, "set point");
    this.mv = within(mv, controller.manifest.mv, "MV");
  }

  setMode(mode) {
    Object.assign(this, { mode, fault: "", good: 0 });
  }

  setSp(sp) {
    this.sp = within(sp, this.controller.manifest.sp, "set point");
  }

  setMv(mv) {
    if (this.mode !== "MANUAL") throw new Refused(`the MV is set by hand in MANUAL only; the loop is in ${this.mode}`);
    this.mv = within(mv, this.controller.manifest.mv, "MV");
  }

  // Another controller takes over; it has no past.
  replace(controller) {
    Object.assign(this, { controller, state: controller.cold() });
  }

  // One period: {pv, dv, mv_applied} -> {mode, mv, law, info, reason}.
  async scan(sample) {
    let reason = this.#refusal(sample);
    if (reason) return this.#miss(reason);
    let applied = this.mv;
    let step;
    try {
      applied = this.#clipped(sample.mv_applied);
      step = await this.controller.step({ sp: this.sp, pv: sample.pv, dv: sample.dv, mv_applied: applied, state: this.state });
    } catch (error) {
      if (this.mode === "AUTO") this.mv = applied;
      return this.#miss(error.message);
    }
    this.state = step.state;
    if (this.fault && ++this.good >= this.recoverAfter) this.setMode("AUTO");
    if (this.mode === "AUTO") this.mv = Array.from(step.mv);
    return { mode: this.mode, mv: [...this.mv], law: Array.from(step.mv), info: Array.from(step.info), reason: this.fault };
  }

  // No past any more; in AUTO a fault, and the MV stays.
  #miss(reason) {
    Object.assign(this, { state: this.controller.cold(), good: 0 });
    if (this.mode === "AUTO" || this.fault) Object.assign(this, { mode: "HOLD", fault: reason });
    return { mode: this.mode, mv: [...this.mv], law: null, info: null, reason };
  }

  #refusal({ pv, dv, mv_applied }) {
    const m = this.controller.manifest;
    const vectors = [["PV", m.pv, pv], ...(m.inputs.includes("dv") ? [["DV", m.dv, dv]] : []), ["applied MV", m.mv, mv_applied]];
    for (const [label, signals, values] of vectors) {
      const bad = signals.findIndex((_, i) => !Number.isFinite(values[i]));
      if (bad >= 0) return `${label} ${signals[bad].name} is ${word(values[bad])}`;
    }
    for (const [i, s] of m.mv.entries()) {
      if (s.values && !s.values.includes(mv_applied[i])) return `applied MV ${s.name} is ${short(mv_applied[i])}, none of ${s.values.join(", ")}`;
      if (!s.values && beyond(s, mv_applied[i], READ_BACK_MARGIN)) return `applied MV ${outside(s, mv_applied[i])}`;
    }
    const out = m.pv.findIndex((s, i) => beyond(s, pv[i], PV_MARGIN));
    return out < 0 ? "" : `PV ${outside(m.pv[out], pv[out])}`;
  }

  #clipped(applied) {
    return this.controller.manifest.mv.map((s, i) => Math.min(Math.max(applied[i], s.low), s.high));
  }
}

// The values, where each lies in its signal's range; Refused says what is allowed.
export function within(values, signals, what) {
  signals.forEach((s, i) => {
    const value = values[i];
    const unit = s.unit === "-" ? "" : ` ${s.unit}`;
    if (!Number.isFinite(value)) throw new Refused(`the ${what} ${s.name} is no finite number; give one from ${short(s.low)} to ${short(s.high)}${unit}`);
    if (s.values && !s.values.includes(value)) throw new Refused(`the ${what} ${s.name} = ${short(value)} is none of ${s.values.join(", ")}`);
    if (!(s.low <= value && value <= s.high)) throw new Refused(`the ${what} ${s.name} = ${value}${unit} is outside [${short(s.low)}, ${short(s.high)}]${unit}`);
  });
  return [...values];
}

const beyond = (s, value, margin) => value < s.low - margin * (s.high - s.low) || value > s.high + margin * (s.high - s.low);
const outside = (s, value) => `${s.name} is ${short(value)} ${s.unit}, outside its range [${short(s.low)}, ${short(s.high)}] ${s.unit}`;
const short = (value) => String(+value.toPrecision(DIGITS));
