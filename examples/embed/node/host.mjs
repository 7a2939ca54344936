// node host.mjs FILE.onnx [SCANS [PERIOD_S [NAME=VALUE ...]]]   a loop on a made-up plant; NAME=VALUE: of what operators
//                                                       may change, as y0.low=-1
// node host.mjs --conformance KIT [ANSWERS.json]        the kit of `loopwright conformance FILE.onnx KIT`
import { readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";
import * as ort from "onnxruntime-node";
import { Controller, Loop } from "../javascript/controller.mjs";
import { MadeUpPlant, operated, run, start } from "../javascript/run.mjs";
import { conform } from "../javascript/vectors.mjs";

const version = createRequire(import.meta.url)("onnxruntime-node/package.json").version;
const json = (path) => JSON.parse(readFileSync(path, "utf8"));

async function conformance(kit, out) {
  const vectors = json(join(kit, "vectors.json"));
  const file = join(kit, vectors.file);
  const host = `Node ${process.versions.node}`;
  const { answers, words, passed } = await conform(
    ort, "cpu", readFileSync(file), json(file.replace(/\.onnx$/, ".json")), vectors, host, version
  );
  console.log(words);
  if (out) writeFileSync(out, JSON.stringify(answers));
  return passed ? 0 : 1;
}

async function control(file, scans = 20, period, ...changes) {
  const controller = await Controller.load(ort, readFileSync(file), json(file.replace(/\.onnx$/, ".json")), "cpu");
  const loop = new Loop(controller, { ...start(controller.manifest), mode: "AUTO", recoverAfter: 5 });
  loop.setOperate(operated(changes));
  await run(loop, new MadeUpPlant(controller.manifest), {
    scans: Number(scans),
    ...(period && { period: Number(period) }),
    now: () => performance.now() / 1e3,
    sleep: (seconds) => new Promise((resume) => setTimeout(resume, 1e3 * seconds)),
    seen: ({ k, late, mode, mv, reason }) => console.log(`${k} ${(1e3 * late).toFixed(2)} ms late ${mode} ${mv ?? "-"} ${reason}`),
  });
  return 0;
}

const [first, ...rest] = process.argv.slice(2);
if (!first || (first === "--conformance" && !rest.length)) {
  console.error("usage: node host.mjs FILE.onnx [SCANS [PERIOD_S [NAME=VALUE ...]]] | node host.mjs --conformance KIT [ANSWERS.json]");
  process.exit(2);
}
try {
  process.exitCode = first === "--conformance" ? await conformance(...rest) : await control(first, ...rest);
} catch (error) {
  console.error(`error: ${error.message}`);
  process.exitCode = 2;
}
