// Every change goes through this one dialog: what, from what to what, who, why, token.
import { change } from "./api.js";
import { element, say } from "./format.js";

const $ = (id) => document.getElementById(id);
const UNAUTHORIZED = 401;
const SETTLE_MS = 400; // after the last key
let looking = 0; // the timer of a look at what would be
let pending = null; // what is asked for now; an answer to an earlier one does not touch this one

// title, words: what will change; fields: [{name, label, said, value, now, unit, min, max, choices}]; request(values): what is
// sent. A field with `now` is sent only where the operator changed it, so that rounding moves nothing. foresee(values):
// an element that shows what the values would do, or null. In place of fields a `body` may be asked in, an element of which
// `said()` tells in a line what is given, and `request()` makes what is sent; it throws an error with `entry` where it cannot.
// `foresee()` then has no values. A dialog that asks for no value is looked at when it opens.
export function ask({ title, words, fields = [], body = null, said = null, request, foresee = null }) {
  const opener = document.activeElement;
  pending = { fields, body, said, request, foresee, touched: new Set(), opener, place: opener?.closest("section") };
  $("dialog-title").textContent = title;
  $("dialog-words").textContent = words;
  $("dialog-fields").replaceChildren(...(body ? [body] : fields.map(field)));
  $("who").value = sessionStorage.getItem("who") || "";
  $("token").value = sessionStorage.getItem("token") || "";
  $("why").value = "";
  $("refusal").textContent = "";
  $("confirm").disabled = false;
  accepts(false);
  moves();
  $("dialog-foreseen").replaceChildren();
  $("dialog").showModal();
  if (!body && !fields.length) look();
  const first = $("dialog").querySelector("#dialog-fields input, #dialog-fields select");
  (first || ($("who").value ? $("why") : $("who"))).focus();
}

function field({ name, label, value, min, max, choices, step }) {
  const given = choices
    ? element("select", { "data-field": name }, ...choices.map(([c, words]) => element("option", { value: c, selected: c === value }, words)))
    : element("input", { "data-field": name, type: "number", step: step || "any", required: true, min, max, value });
  given.dataset.first = given.value;
  return element("label", {}, label + " ", given, element("span", { class: "wrong", id: `wrong-${name}` }));
}

// A controller that is not proven gets into AUTO by a second word only, which is written down.
function accepts(unproven) {
  pending.accept = Boolean(unproven);
  $("confirm").textContent = unproven ? "Accept, though not proven" : "Confirm";
}

const inputs = () => [...$("dialog-fields").querySelectorAll("[data-field]")];
const changed = (input) => pending.touched.has(input.dataset.field) || input.value !== input.dataset.first;

// The fields that will be sent, each with its input.
const wanted = () =>
  (pending.body ? [] : inputs())
    .map((input, i) => [pending.fields[i], input])
    .filter(([given, input]) => given.now === undefined || changed(input));

function moves() {
  if (pending.said) return say($("dialog-moves"), pending.said());
  const said = wanted()
    .filter(([given]) => given.now !== undefined)
    .map(([given, input]) => {
      const to = input.selectedOptions ? input.selectedOptions[0].textContent : input.value;
      return `${given.said ? `${given.said}:` : given.name} ${given.now || "–"} → ${to || "…"} ${given.unit}`.trim();
    });
  say($("dialog-moves"), said.join(", "));
}

// Courses under the values, once the operator has stopped typing for a moment.
function look() {
  clearTimeout(looking);
  if (!pending.foresee) return;
  const mine = pending;
  looking = setTimeout(async () => {
    const values = wantedValues();
    let shown = [];
    wrong(null);
    try {
      const asked = Object.keys(values).length || !mine.fields.length ? mine.foresee(values) : null;
      if (asked) $("dialog-foreseen").replaceChildren(element("p", { class: "hint" }, "The law is asked what it would do…"));
      shown = [await asked].filter(Boolean);
    } catch (error) {
      if (mine !== pending) return;
      if (!wrong(error.entry, error.message, false)) shown = [error.message];
    }
    if (mine === pending) $("dialog-foreseen").replaceChildren(...shown);
  }, SETTLE_MS);
}

const wantedValues = () => Object.fromEntries(wanted().map(([given, input]) => [given.name, Number(input.value)]));

async function confirm(event) {
  event.preventDefault();
  const mine = pending;
  const sent = wanted();
  if (mine.fields.length && !sent.length) return say($("refusal"), "No value is changed yet.");
  const values = wantedValues();
  const [who, reason, token] = ["who", "why", "token"].map((id) => $(id).value.trim());
  sessionStorage.setItem("who", who);
  $("refusal").textContent = "";
  wrong(null);
  $("confirm").disabled = true;
  let said, refused;
  try {
    const accepted = mine.accept && { accept_unproven: true };
    said = `Done: ${await change({ ...mine.request(values), ...accepted, who, reason }, token)}`;
  } catch (error) {
    refused = error;
    said = error.status || error.entry ? `Not done: ${error.message}` : error.message;
  }
  if (refused?.status !== UNAUTHORIZED) sessionStorage.setItem("token", token);
  const open = pending === mine && $("dialog").open;
  if (open) $("confirm").disabled = false;
  if (refused && open) {
    const unproven = refused.needs === "accept_unproven";
    accepts(unproven);
    $("refusal").textContent = unproven
      ? `Not done: not proven in closed loop. ${refused.unproven}. Accept it, and it moves the plant in AUTO all the same; that is written down.`
      : wrong(refused.entry, refused.message)
        ? `Not done: see ${inputs().find((input) => input.dataset.field === refused.entry).dataset.said || refused.entry}.`
        : said;
    if (refused.status === UNAUTHORIZED) $("token").select();
    return;
  }
  $("answer").textContent = said; // the dialog may have been left meanwhile; the answer is still told
  if (open) $("dialog").close();
}

// The loop's own words beside the entry that it refused; false where no field is of that name.
function wrong(name, words, focus = true) {
  let shown = false;
  for (const input of inputs()) {
    const mine = name && input.dataset.field === name;
    const line = $(`wrong-${input.dataset.field}`);
    line.textContent = mine ? words : "";
    for (const [attribute, value] of [["aria-invalid", "true"], ["aria-describedby", line.id]]) {
      if (mine) input.setAttribute(attribute, value);
      else input.removeAttribute(attribute);
    }
    if (mine && focus) input.focus();
    shown ||= Boolean(mine);
  }
  return shown;
}

// The button that opened the dialog may be gone: then a keyboard goes on in its section, not at the page's top.
function closed() {
  const { opener, place } = pending;
  if (opener?.isConnected || !place) return;
  place.tabIndex = -1;
  place.focus();
}

$("form").addEventListener("submit", confirm);
$("dialog-fields").addEventListener("input", (event) => {
  pending.touched.add(event.target.dataset.field);
  moves();
  look();
});
$("cancel").addEventListener("click", () => $("dialog").close());
$("dialog").addEventListener("close", closed);
