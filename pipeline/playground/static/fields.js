// A quantity set by hand: a slider and a number, or a choice where only some values are allowed.
import { element, number, unit } from "loopwright/format";

let count = 0;

// `apply(value)` may throw; its words are shown, and the value before it stays.
export function field({ name, signal, value, apply, strict = true, tag = null }) {
  const id = `field-${count++}`;
  const refusal = element("p", { class: "refusal", role: "alert" });
  const said = { min: signal.low, max: signal.high };
  const fine = (signal.high - signal.low) / 1000;
  const box = signal.values
    ? element("select", { id, "data-field": name }, ...signal.values.map((v) => element("option", { value: v }, String(v))))
    : element("input", { id, type: "number", step: "any", "data-field": name, ...(strict ? said : {}) });
  const slider = signal.values ? null : element("input", { type: "range", ...said, step: fine, "aria-label": `${signal.name}, slider`, "data-slider": name });

  const tell = (given, from) => {
    try {
      apply(given);
      refusal.textContent = "";
      box.removeAttribute("aria-invalid");
      show(given, from);
    } catch (error) {
      refusal.textContent = error.message;
      box.setAttribute("aria-invalid", "true");
    }
  };
  const show = (present, from = null) => {
    if (from !== box && document.activeElement !== box) box.value = signal.values ? present : plain(present);
    if (slider && from !== slider) slider.value = present;
    if (tag) tag(present);
  };
  box.addEventListener("change", () => tell(box.value.trim() === "" ? NaN : Number(box.value), box));
  if (slider) slider.addEventListener("input", () => {
    box.value = Number(number(Number(slider.value), signal));
    tell(Number(box.value), slider);
  });
  show(value);
  const label = element("label", { for: id }, element("span", { class: "name" }, signal.name), element("span", { class: "unit" }, ` ${unit(signal)}`));
  const node = element("div", { class: "field" }, label, box, slider ?? "", refusal);
  const enable = (able) => {
    box.disabled = !able;
    if (slider) slider.disabled = !able;
  };
  const fresh = (present) => {
    refusal.textContent = "";
    box.removeAttribute("aria-invalid");
    box.value = signal.values ? present : plain(present);
    if (slider) slider.value = present;
    if (tag) tag(present);
  };
  return { node, show, enable, fresh };
}

// Seven digits: a value that is computed is not shown to its last bit.
const plain = (value) => String(+Number(value).toPrecision(7));
