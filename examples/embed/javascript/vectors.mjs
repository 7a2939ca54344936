// The conformance kit in JavaScript: run its vectors, compare, and say the largest difference.
import { Controller, Loop, Refused } from "./controller.mjs";

// Hexadecimal floats as C and Python write them: 0x1.8000000000000p+1, nan, inf, -inf. 53 bits are exact in a Number.
export function fromHex(text) {
  const named = { nan: NaN, inf: Infinity, "-inf": -Infinity }[text];
  if (named !== undefined) return named;
  const parts = /^(-?)0x([01])\.([0-9a-f]*)p([+-]\d+)$/.exec(text);
  if (!parts) throw new Error(`${text} is no hexadecimal float`);
  const [, sign, whole, digits, exponent] = parts;
  const value = parseInt(whole + digits, 16) * 2 ** (-4 * digits.length) * 2 ** Math.max(+exponent, -1022);
  return sign ? -value : value;
}

export function toHex(value) {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf";
  const view = new DataView(new ArrayBuffer(8));
  view.setFloat64(0, value);
  const bits = view.getBigUint64(0).toString(2).padStart(64, "0");
  const exponent = parseInt(bits.slice(1, 12), 2);
  const digits = BigInt("0b" + bits.slice(12)).toString(16).padStart(13, "0");
  const power = exponent ? exponent - 1023 : /1/.test(bits.slice(12)) ? -1022 : 0;
  return `${bits[0] === "1" ? "-" : ""}0x${exponent ? 1 : 0}.${digits}p${power < 0 ? "" : "+"}${power}`;
}

const numbers = (texts) => (texts === null ? null : Float64Array.from(texts, fromHex));
const OUTPUTS = ["mv", "state_next", "info"];

// The smallest step of the clock [ms]: 0.1 in a browser, hardly any in Node.
function tick() {
  const began = performance.now();
  for (;;) {
    const now = performance.now();
    if (now > began) return now - began;
  }
}

// Median duration [us] of a step, refused or not; in blocks of 20 steps where the clock is coarse.
async function medianStep(controller, given) {
  const took = [], block = tick() > 0.01 ? 20 : 1;
  for (let k = 0; k < 600; k += block) {
    const began = performance.now();
    for (let i = 0; i < block; i++) await controller.step(given).catch(() => {});
    took.push((1e3 * (performance.now() - began)) / block);
  }
  return took.sort((a, b) => a - b)[took.length >> 1];
}

// {answers, words, passed}: the answers for `loopwright conformance FILE OUT --check`, and the result in words.
export async function conform(ort, provider, bytes, manifest, vectors, host, version) {
  if (vectors.kit !== 6)
    throw new Error(`the kit has the version ${vectors.kit}, not 6: write it again with loopwright conformance FILE.onnx KIT`);
  const controller = await Controller.load(ort, bytes, manifest, provider);
  if (manifest.sha256 !== vectors.sha256) throw new Error("the vectors are of another controller file");
  const scale = Object.fromEntries(OUTPUTS.map((name) => [name, numbers(vectors.scale[name])]));
  const largest = { steps: 0, chained: 0 };
  let wrong = 0, last;
  const compared = (run, name, ours, texts) => {
    if (texts) numbers(texts).forEach((value, i) => {
      const share = Math.abs(ours[i] - value) / scale[name][i];
      largest[run] = Math.max(largest[run], Number.isNaN(share) ? Infinity : share);
    });
    return Array.from(ours, toHex);
  };

  // "steps": each from the state that the kit gives; "chained": from our own last one.
  const played = async (run) => {
    const answers = [];
    let state;
    for (const row of vectors.steps) {
      const given = Object.fromEntries(Object.entries(row.given).map(([name, texts]) => [name, numbers(texts)]));
      if (run === "steps" || row.begins) state = given.state;
      try {
        const result = await controller.step({ ...given, state });
        last = { ...given, state };
        state = result.state_next;
        answers.push(Object.fromEntries(OUTPUTS.map((name) => [name, compared(run, name, result[name], row.gives?.[name])])));
        if (row.refused) wrong++;
      } catch (error) {
        if (!(error instanceof Refused)) throw error;
        if (error.because !== row.refused) wrong++;
        answers.push({ refused: error.because });
      }
    }
    return answers;
  };
  const steps = await played("steps");
  const chained = await played("chained");

  const { sp, mv, recover_after: recoverAfter, max_gap: maxGap } = vectors.loop;
  const loop = new Loop(controller, { sp: numbers(sp), mv: numbers(mv), mode: "AUTO", recoverAfter, maxGap });
  const scans = [];
  for (const row of vectors.scans) {
    if (row.set_mode) loop.setMode(row.set_mode);
    try {
      if (row.set_mv) loop.setMv(numbers(row.set_mv));
    } catch (error) {
      if (!(error instanceof Refused)) throw error; // it may have to be refused
    }
    if (row.unwritten) loop.unwritten("the plant cannot be written"); // the command of the scan before
    if (row.missed) loop.gap(row.missed);
    const { pv, dv, mv_applied, age_s } = row.sample ?? {};
    const sample = row.sample && { pv: numbers(pv), dv: numbers(dv), mv_applied: numbers(mv_applied), age_s: fromHex(age_s) };
    const command = await loop.scan(sample);
    const mv = command.mv && compared("chained", "mv", command.mv, row.mv);
    const answer = { mode: command.mode, fault: command.reason !== "", mv };
    if (answer.mode !== row.mode || answer.fault !== row.fault || !mv !== !row.mv) wrong++;
    scans.push(answer);
  }

  const p50 = await medianStep(controller, last);
  return {
    answers: { host, onnxruntime: version, sha256: manifest.sha256, p50_us: p50, steps, chained, scans },
    words: `${host}, onnxruntime ${version}: ${steps.length} steps, ${scans.length} scans, ` +
      `largest difference ${largest.steps.toPrecision(3)}, chained ${largest.chained.toPrecision(3)}, ${wrong} wrong, step p50 ${p50.toFixed(1)} us`,
    passed: !wrong && largest.steps <= fromHex(vectors.tolerance) && largest.chained <= fromHex(vectors.chained_tolerance),
  };
}
