// The controller's card, the monitor's verdicts, and swapping.
import { ask } from "./dialog.js";
import { element, figure, here } from "./format.js";

const $ = (id) => document.getElementById(id);
const TRIAL = 60;
const COLUMNS = 4;
const SIGNS = { "as validated": "●", watch: "◆", retrain: "▲", "not known yet": "○" };
const URGENT = ["retrain", "watch"];
let judged = "";

export function describe(about) {
  const c = about.card;
  const digest = element("button", { type: "button", class: "digest", title: "copy the whole digest", onclick: copy }, c.sha256.slice(0, 16) + "…");
  digest.dataset.whole = c.sha256;
  const facts = [
    ["law", c.law],
    ["case", c.case],
    ["file", c.file],
    ["sha256", digest],
    ["signed by", c.signed ? signer(c.signed) : "not checked: trusted is not set"],
    ["period", `${c.period_s} s`],
    ["closed loop", c.unproven === undefined ? "not known" : c.unproven ? `NOT PROVEN: ${c.unproven}` : "proven"],
    ["lock-ups", c.lock_ups === 0 ? "none in its validation" : String(c.lock_ups ?? "not known")],
    ["certificate", certificate(c.certificate)],
  ];
  const making = [
    ["commit", c.commit ? c.commit.slice(0, 12) : "–"],
    ["versions", Object.entries(c.versions || {}).map(([k, v]) => `${k} ${v}`).join(", ") || "–"],
    ["size", `${Math.round(c.size_bytes / 1024)} KiB`],
  ];
  const made = element("details", {}, element("summary", {}, "How it was made"), list(making));
  const picture = c.picture && element("img", { src: c.picture, alt: "closed loop of its validation", loading: "lazy" });
  const notes = (about.warnings || []).map((words) => element("p", { class: "note" }, `◆ ${here(words)}`));
  $("card-body").replaceChildren(list(facts), ...notes, scenarios(c), made, picture || "", candidates(about));
}

const list = (facts) => element("dl", {}, ...facts.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));

function signer(signed) {
  const until = signed.expires ? `, until ${signed.expires.slice(0, 10)}` : "";
  return element("span", { title: `key ${signed.fingerprint}` }, `${signed.name} (key ${signed.fingerprint.slice(0, 16)})${until}`);
}

// The sentence, and on demand what it rests on: what a failure is, what was drawn, and what was not.
function certificate(found) {
  if (!found || !(found.lines.length || found.wrong)) return "none";
  if (found.wrong) return `NOT TO BE BELIEVED: ${found.wrong}`;
  const [sentence, ...grounds] = found.lines;
  return element("details", {}, element("summary", {}, sentence), ...grounds.map((words) => element("p", {}, words)));
}

async function copy(event) {
  const digest = event.currentTarget;
  digest.textContent = digest.dataset.whole;
  try {
    await navigator.clipboard.writeText(digest.dataset.whole);
  } catch {
    // not allowed here; the whole digest is shown and can be marked
  }
}

function scenarios(c) {
  const rows = Object.entries(c.scenarios || {});
  if (!rows.length) return element("p", { class: "note" }, "This controller was not validated.");
  const columns = Object.keys(rows[0][1]).slice(0, COLUMNS);
  const named = (name) => (c.units && c.units[name] ? `${name} [${c.units[name]}]` : name);
  return element(
    "details",
    {},
    element("summary", {}, `Evidence: ${rows.length} closed loops of its validation`),
    element(
      "div",
      { class: "scroll", tabindex: 0, role: "region", "aria-label": "Evidence" },
      element(
        "table",
        {},
        element("thead", {}, element("tr", {}, element("th", {}, "test"), ...columns.map((n) => element("th", {}, named(n))))),
        element(
          "tbody",
          {},
          ...rows.map(([test, row]) => element("tr", {}, element("th", {}, test), ...columns.map((n) => element("td", {}, figure(row[n]))))),
        ),
      ),
    ),
  );
}

function candidates(about) {
  const box = element("div", { id: "candidates" }, element("h3", {}, "Swap the controller"), element("div", { id: "back", hidden: true }));
  if (!about.candidates.length) box.append(element("p", { class: "calm" }, "No other controller with these signals lies beside this one's file."));
  for (const other of about.candidates) {
    const of = `${other.file}, ${other.sha256.slice(0, 8)}${other.signed ? `, signed by ${other.signed}` : ""}`;
    box.append(
      element(
        "div",
        { class: "candidate" },
        element("span", {}, `${other.law} for ${other.case} `, element("small", {}, `(${of})`)),
        element("button", { type: "button", "data-file": other.file, "aria-label": `Try ${other.file}…`, onclick: () => swap(about, other) }, "Try…"),
      ),
    );
  }
  return box;
}

const trialField = { name: "trial", label: "Good scans of trial", value: TRIAL, min: 1, max: 1000000, step: 1 };

function swap(about, other) {
  ask({
    title: `Try ${other.law}`,
    words: `${other.file} runs beside ${about.card.law}, in the shadow. After the trial it takes over without a bump.`,
    fields: [trialField],
    request: (values) => ({ do: "swap", value: { file: other.file, sha256: other.sha256, trial: values.trial } }),
  });
}

export function show(state) {
  const back = $("back");
  if (back) {
    back.hidden = !state.replaced || Boolean(state.successor);
    if (state.replaced && back.dataset.of !== state.replaced.sha256) {
      back.dataset.of = state.replaced.sha256;
      const act = () =>
        ask({
          title: `Put ${state.replaced.law} back`,
          words: `${state.replaced.file} had the plant before. It is tried beside the present one first.`,
          fields: [trialField],
          request: (values) => ({ do: "back", value: { trial: values.trial } }),
        });
      back.replaceChildren(element("button", { id: "put-back", type: "button", onclick: act }, `Put ${state.replaced.law} (${state.replaced.sha256.slice(0, 8)}) back…`));
    }
  }
  verdicts(state.verdicts || []);
}

// Verdicts that need somebody come first; the rest is counted, and listed on demand. Written only where something is new.
function verdicts(found) {
  const text = JSON.stringify(found);
  if (text === judged) return;
  judged = text;
  const urgent = found.filter((v) => URGENT.includes(v.level)).sort((a, b) => URGENT.indexOf(a.level) - URGENT.indexOf(b.level));
  const calm = found.filter((v) => !URGENT.includes(v.level));
  const counts = Object.keys(SIGNS).flatMap((level) => {
    const n = calm.filter((v) => v.level === level).length;
    return n ? [`${SIGNS[level]} ${n} ${level}`] : [];
  });
  $("verdicts").replaceChildren(...urgent.map(verdict));
  $("calm-verdicts").hidden = !calm.length;
  $("calm-counts").textContent = counts.join("   ");
  $("calm-list").replaceChildren(...calm.map(verdict));
  $("no-verdicts").hidden = found.length > 0;
}

function verdict(v) {
  return element(
    "li",
    { class: "verdict", "data-level": v.level },
    element("span", { class: "sign", "aria-hidden": "true" }, SIGNS[v.level] || "○"),
    element("span", { class: "name" }, v.name),
    element("span", { class: "level" }, v.level),
    element("span", { class: "what" }, here(v.text)),
  );
}
