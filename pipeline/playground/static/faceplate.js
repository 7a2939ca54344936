// One controller: which it is, its mode, what it does, and what its law tells of itself.
import { field } from "loopwright/fields";
import { element, figure, number, say, unit } from "loopwright/format";

const MODES = { AUTO: "The law sets the MV.", MANUAL: "You set the MV.", HOLD: "The last MV stays." };
const NEAR = 1e-6; // share of a range within which two values are one
const atEnd = (value, s) => Math.min(Math.abs(value - s.low), Math.abs(value - s.high)) <= NEAR * (s.high - s.low);

export class Faceplate {
  // `changed` is told what was done here, `said` the same where no controller or mode changed.
  constructor(box, lane, simulation, { changed, said }) {
    Object.assign(this, { box, lane, simulation, about: simulation.about });
    const { about } = this;
    const i = lane === "A" ? 0 : 1;
    this.choice = element("select", { "aria-label": `Controller ${lane}`, "data-choose": lane }, ...about.controllers.map((c) => element("option", { value: c.name }, c.short)));
    this.choice.value = simulation.chosen[i];
    this.choice.addEventListener("change", async () => {
      await simulation.choose(i, this.choice.value);
      changed(lane, `${this.choice.selectedOptions[0].text} takes over, with no past`);
    });
    this.mode = element("output", { class: "mode", "data-mode": "", "aria-live": "polite" });
    this.buttons = ["AUTO", "MANUAL"].map((mode) =>
      element("button", { type: "button", "data-mode": mode, onclick: () => {
        if (this.here.loop.mode === mode) return;
        const before = this.here.loop.mode;
        this.here.loop.setMode(mode);
        changed(lane, `${before} → ${mode}`);
      } }, mode));
    this.words = element("p", { class: "hint" });
    this.title = element("p", { class: "hint title" });
    this.reason = element("p", { class: "reason", hidden: true });
    this.values = element("div", { class: "values" });
    this.hands = about.mv.map((s, place) => field({
      name: `MV ${lane} ${s.name}`,
      signal: s,
      value: simulation.lanes[i].loop.mv[place],
      apply: (value) => {
        const { loop } = this.here;
        const present = loop.wanted ?? loop.mv; // another MV may be on its way
        const before = present[place];
        loop.setMv(present.map((v, j) => (j === place ? value : v)));
        if (value !== before) said(lane, `MV by hand: ${s.name} = ${+value.toPrecision(6)} ${unit(s)}`);
      },
    }));
    this.notes = element("ul", { class: "notes", "aria-live": "polite" });
    this.info = element("dl", {});
    box.replaceChildren(
      element("div", { class: "faceplate-head" }, element("h2", {}, element("span", { class: `key key-${lane}`, "aria-hidden": "true" }), ` ${lane}`), this.choice),
      this.title,
      element("div", { class: "mode-line" }, this.mode, element("div", { class: "buttons" }, ...this.buttons)),
      this.words,
      this.reason,
      this.values,
      this.notes,
      element("details", { class: "hand" }, element("summary", {}, "MV by hand"), ...this.hands.map((h) => h.node), element("p", { class: "hint" }, "In MANUAL only.")),
      element("details", {}, element("summary", {}, "What the law tells"), this.info),
    );
    this.hand = box.querySelector(".hand");
  }

  get here() {
    return this.simulation.lanes.find((l) => l.name === this.lane);
  }

  show() {
    const { here, about } = this;
    const { loop, scan } = here;
    say(this.mode, loop.mode);
    this.mode.dataset.mode = loop.mode;
    say(this.words, MODES[loop.mode]);
    say(this.title, loop.controller.manifest.title);
    for (const button of this.buttons) button.setAttribute("aria-pressed", String(button.dataset.mode === loop.mode));
    const reason = scan?.reason && loop.mode !== "AUTO" ? `▲ ${scan.reason}` : "";
    this.reason.hidden = !reason;
    say(this.reason, reason);
    this.values.replaceChildren(...this.rows());
    this.hands.forEach((hand, i) => {
      hand.enable(loop.mode === "MANUAL");
      hand.show(loop.mv[i]);
    });
    if (this.hand.dataset.mode !== loop.mode) {
      if (loop.mode === "MANUAL") this.hand.open = true;
      this.hand.dataset.mode = loop.mode;
    }
    const told = notes(about, loop.controller.manifest, scan);
    const text = JSON.stringify(told);
    if (this.notes.dataset.text !== text) {
      this.notes.dataset.text = text;
      this.notes.replaceChildren(...told.map(({ watch, words }) => element("li", { class: watch ? "watch" : "" }, `${watch ? "◆" : "○"} ${words}`)));
    }
    const names = loop.controller.manifest.info;
    this.info.replaceChildren(...names.flatMap((name, i) => [element("dt", {}, name), element("dd", {}, figure(scan?.info?.[i]))]));
  }

  // Shows the changes of another reset or another test.
  fresh() {
    this.choice.value = this.simulation.chosen[this.lane === "A" ? 0 : 1];
    this.hands.forEach((hand, i) => hand.fresh(this.here.loop.mv[i]));
    this.show();
  }

  rows() {
    const { about, simulation, here } = this;
    const made = about.pv.map((s, i) => this.row("PV", s, here.measured[i], i < about.sp.length ? simulation.sp[i] : null, Number.isNaN(here.measured[i])));
    made.push(...about.mv.map((s, i) => this.row("MV", s, here.mv[i], null, simulation.stuck[i], "stuck")));
    if (simulation.k) {
      const s = about.sp[0];
      made.push(element("div", { class: "value mean", "data-mean": this.lane }, element("span", { class: "kind" }, "mean |SP − PV|"), element("span", { class: "name" }), element("span", { class: "number" }, figure(here.error / simulation.k)), element("span", { class: "unit" }, about.sp.length === 1 ? unit(s) : "")));
    }
    return made;
  }

  row(kind, signal, value, mark, bad, words = "no value") {
    const share = (v) => Math.min(100, Math.max(0, (100 * (v - signal.low)) / (signal.high - signal.low))) || 0;
    const fill = element("div", { class: "fill" });
    fill.style.width = `${share(value)}%`;
    const bar = element("div", { class: "bar", title: `${signal.low} … ${signal.high} ${unit(signal)}` }, fill);
    if (mark !== null) {
      const line = element("div", { class: "mark" });
      line.style.left = `${share(mark)}%`;
      bar.append(line);
    }
    return element("div", { class: bad ? "value bad" : "value", "data-signal": `${kind} ${this.lane} ${signal.name}` },
      element("span", { class: "kind" }, kind), element("span", { class: "name" }, signal.name), element("span", { class: "number" }, signal.values ? String(value) : number(value, signal)),
      element("span", { class: "unit" }, unit(signal)), bar, element("span", { class: "quality" }, bad ? `▲ ${words}` : ""));
  }
}

// In words, what of the law's own numbers a person should know. Nothing when all is well.
export function notes(about, manifest, scan) {
  if (!scan) return [];
  const told = [];
  const tell = (words, watch = false) => told.push({ words: words.trim(), watch });
  const of = (name) => (scan.info && manifest.info.includes(name) ? scan.info[manifest.info.indexOf(name)] : null);
  if (of("in_domain") === 0) tell(`outside its applicability domain (leverage ${figure(of("leverage"))}): its models never saw such a state`, true);
  const [low, high, sp] = [of("sp_min"), of("sp_max"), of("sp_requested")];
  const s = about.sp[0];
  const span = s.high - s.low;
  if (low !== null && high !== null && sp !== null && low < high) {
    const at = Math.abs(sp - low) < NEAR * span ? low : Math.abs(sp - high) < NEAR * span ? high : null;
    if (at !== null) tell(`it asks for ${s.name} = ${number(at, s)} ${unit(s)} next, the end of what it may ask for`);
  }
  manifest.mv.forEach((mv, i) => {
    const asked = of(manifest.mv.length === 1 ? "mv_requested" : `${mv.name}_requested`);
    if (asked !== null && (asked < mv.low || asked > mv.high)) tell(`${mv.name} is at its limit; the law would give ${figure(asked)} ${unit(mv)}`);
    else if (!mv.values && scan.law && scan.mode === "AUTO" && atEnd(scan.law[i], mv)) tell(`${mv.name} is at its limit`);
  });
  return told;
}
