// node host.mjs LAW.wasm --conformance KIT [ANSWERS.json]   the kit of `loopwright conformance FILE.onnx KIT`, stepped by the
//                                                       plain C of the file: no package is needed
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { plain } from "../javascript/plain.mjs";
import { conform } from "../javascript/vectors.mjs";

const [module, flag, kit, out] = process.argv.slice(2);
if (flag !== "--conformance" || !kit) {
  console.error("usage: node host.mjs LAW.wasm --conformance KIT [ANSWERS.json]");
  process.exit(2);
}
try {
  const json = (path) => JSON.parse(readFileSync(path, "utf8"));
  const ort = await plain(readFileSync(module)), vectors = json(join(kit, "vectors.json")), file = join(kit, vectors.file);
  const manifest = json(file.replace(/\.onnx$/, ".json"));
  const { answers, words, passed } = await conform(ort, "wasm", readFileSync(file), manifest, vectors, "WebAssembly", "none: plain C");
  console.log(words);
  if (out) writeFileSync(out, JSON.stringify(answers));
  process.exitCode = passed ? 0 : 1;
} catch (error) {
  console.error(`error: ${error.message}`);
  process.exitCode = 2;
}
