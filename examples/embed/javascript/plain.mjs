// A controller in plain C, compiled to WebAssembly (../wasm), in the place of onnxruntime: what controller.mjs and
// vectors.mjs take as `ort`. It is of one controller file alone, and refuses another one.

const INPUTS = ["sp", "pv", "dv", "mv_applied", "state", "operate", "fresh", "ahead"];
const OUTPUTS = ["mv", "state_next", "info"]; // they follow the inputs in the module's order

class Tensor {
  constructor(type, data, dims) {
    Object.assign(this, { type, data, dims });
  }
}

// `module` are the bytes of law.wasm. The module imports nothing.
export async function plain(module) {
  const { instance } = await WebAssembly.instantiate(module, {});
  const { memory, numbers, size, step, reads, sha256 } = instance.exports;
  const text = (at) => {
    const bytes = new Uint8Array(memory.buffer);
    return new TextDecoder().decode(bytes.subarray(at, bytes.indexOf(0, at)));
  };
  const digest = text(sha256()), inputNames = text(reads()).split(" ");
  const view = (place) => new Float64Array(memory.buffer, numbers(place), size(place)); // the memory never grows
  const given = Object.fromEntries(inputNames.map((name) => [name, view(INPUTS.indexOf(name))]));
  const found = Object.fromEntries(OUTPUTS.map((name, i) => [name, view(INPUTS.length + i)]).filter(([, values]) => values.length));

  const session = {
    inputNames,
    outputNames: Object.keys(found),
    async run(feeds) {
      for (const [name, into] of Object.entries(given)) into.set(feeds[name].data);
      step();
      return Object.fromEntries(Object.entries(found).map(([name, values]) => [name, new Tensor("float64", values, [values.length])]));
    },
  };
  const InferenceSession = {
    async create(bytes) {
      const of = [...new Uint8Array(await crypto.subtle.digest("SHA-256", bytes))].map((b) => b.toString(16).padStart(2, "0")).join("");
      if (of !== digest) throw new Error(`the WebAssembly module is of the file with the SHA-256 ${digest}, and this one has ${of}`);
      return session;
    },
  };
  return { Tensor, InferenceSession };
}
