// A controller file: one step in engineering units, with the refusals of the runtime (serving/controller.py).
export class Refused extends Error {}

const INPUTS = ["sp", "pv", "dv", "mv_applied", "state"];
const NONE = new Float64Array(0);

export class Controller {
  // `bytes` is the .onnx file, `manifest` what case.json says of it.
  static async load(ort, create, bytes, manifest) {
    // Browsers compute digests for https, localhost and files; elsewhere the file is taken as it is.
    if (crypto.subtle) {
      const found = [...new Uint8Array(await crypto.subtle.digest("SHA-256", bytes))].map((b) => b.toString(16).padStart(2, "0")).join("");
      if (found !== manifest.sha256) throw new Refused(`${manifest.file}: the file's SHA-256 is ${found}, not ${manifest.sha256}: it was changed after the page was written`);
    }
    return new Controller(ort, await create(bytes), manifest);
  }

  constructor(ort, session, manifest) {
    Object.assign(this, { ort, session, manifest });
    this.signals = { sp: manifest.sp, pv: manifest.pv, dv: manifest.dv, mv_applied: manifest.mv };
    const same = (a, b) => [...a].sort().join() === [...b].sort().join();
    if (!same(session.inputNames, manifest.inputs)) throw new Refused(`${manifest.file}: the graph's inputs are ${session.inputNames}, its manifest says ${manifest.inputs}`);
  }

  // State zero means: no past. Also right after any gap.
  cold() {
    return new Float64Array(this.manifest.n_state);
  }

  // {sp, pv, dv, mv_applied, state} -> {mv, state, info}; Refused where no MV may be computed or used.
  async step(given) {
    const m = this.manifest;
    const feeds = {};
    for (const name of INPUTS.filter((n) => m.inputs.includes(n))) {
      const signals = this.signals[name];
      const values = Float64Array.from(given[name]);
      const length = signals ? signals.length : m.n_state;
      if (values.length !== length) throw new Refused(`${name} has ${values.length} values; it needs ${length}`);
      const bad = values.findIndex((v) => !Number.isFinite(v));
      if (bad >= 0) {
        const label = signals ? `${signals[bad].name} [${signals[bad].unit}]` : `entry ${bad}`;
        throw new Refused(`${name}: ${label} is ${word(values[bad])}; no MV is computed from a value that is not finite`);
      }
      feeds[name] = new this.ort.Tensor("float64", values, [length]);
    }
    const made = await this.session.run(feeds);
    const [mv, state, info] = ["mv", "state_next", "info"].map((name) => (made[name] ? Float64Array.from(made[name].data) : NONE));
    this.#refuse({ mv, state_next: state, info });
    return { mv, state, info };
  }

  #refuse(outputs) {
    for (const [label, values] of Object.entries(outputs)) {
      const bad = values.findIndex((v) => !Number.isFinite(v));
      if (bad >= 0) throw new Refused(`the law gave ${label}[${bad}] = ${word(values[bad])}, which is not finite`);
    }
    this.manifest.mv.forEach((s, i) => {
      const value = outputs.mv[i];
      if (!(s.low <= value && value <= s.high)) throw new Refused(`the law gave ${s.name} = ${value} ${s.unit}, outside its range [${s.low}, ${s.high}] ${s.unit}`);
      if (s.values && !s.values.includes(value)) throw new Refused(`the law gave ${s.name} = ${value}; it may be one of ${s.values.join(", ")}`);
    });
  }
}

// A value that is not finite, as the runtime writes it.
export const word = (value) => (Number.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf");
