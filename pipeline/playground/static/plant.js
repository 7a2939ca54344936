// The plant: its sampled transition and its measurement as graphs, for all lanes in one run.
export class Plant {
  static async load(ort, create, read, about) {
    const [transition, measurement] = await Promise.all(["plant-transition.onnx", "plant-measurement.onnx"].map(read));
    return new Plant(ort, await create(transition), await create(measurement), about);
  }

  constructor(ort, transition, measurement, about) {
    Object.assign(this, { ort, transition, measurement, n_pv: about.pv.length });
  }

  // Rows of numbers as the graph's (n, m), and back.
  #tensor(rows) {
    return new this.ort.Tensor("float64", Float64Array.from(rows.flat()), [rows.length, rows[0].length]);
  }

  #rows(tensor) {
    const [n, m] = tensor.dims;
    return Array.from({ length: n }, (_, i) => Array.from(tensor.data.subarray(i * m, (i + 1) * m)));
  }

  // The states one period later: x, mv a row a lane; dv and p the same for all.
  async step(x, mv, dv, p) {
    const given = { x, mv, dv: x.map(() => dv), p: x.map(() => p) };
    const feeds = Object.fromEntries(this.transition.inputNames.map((name) => [name, this.#tensor(given[name])]));
    return this.#rows((await this.transition.run(feeds)).x_next);
  }

  // The process variables of the states.
  async measure(x) {
    return this.#rows((await this.measurement.run({ x: this.#tensor(x) })).pv);
  }
}
