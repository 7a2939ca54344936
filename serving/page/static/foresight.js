// Courses that the law predicts and plans, why it moves, and what it would do after a change. The page's server computes it
// beside the loop, from the inputs of the loop's last step.
import { duration, element, figure, number, unit } from "./format.js";
import { get } from "./api.js";

const AGAIN_MS = 10_000; // after a refusal: a law that is not stepped yet will be, a file that is missing may come
const SHARE = 0.4; // of the time that is shown, which the future may have beside it
const DASH = [5, 4];
const STANDS = 5e-4; // of an MV's range: a smaller move is none, as the sentence has it
let found = null; // { time, courses, moves }
let missing = ""; // why there is none
let speed = 1;
let law = ""; // whose it is
let asking = false;
let next_ms = 0; // before which it is not asked for
let steers = false;
let auto = false; // in any other mode the law moves nothing: what it would do is no prediction of the plant

export function describe(about) {
  steers = (about.operate || []).length > 0;
  speed = about.speed || 1;
  if (law === about.card.sha256) return;
  law = about.card.sha256;
  [found, missing, next_ms] = [null, "", 0];
}

export function follow(mode) {
  auto = mode === "AUTO";
}

// Asks for it anew, at most once at a time; true where there is something new.
export async function refresh() {
  if (!steers || asking || Date.now() < next_ms || document.visibilityState === "hidden") return false;
  asking = true;
  const [of, before] = [law, found?.time];
  try {
    const news = await get("/api/explain");
    if (of !== law) return false;
    [found, missing] = [news, ""];
  } catch (error) {
    [found, missing, next_ms] = [null, error.message, Date.now() + AGAIN_MS];
  } finally {
    asking = false;
  }
  return found?.time !== before;
}

export const why = () => missing;
const course = (signal) => (auto ? found?.courses.find((c) => c.signal === signal.name) : undefined);
export const move = (signal) => (auto ? found?.moves.find((m) => m.mv === signal.name) : undefined);

// The seconds after now that are drawn beside `span` seconds of the past.
export function ahead(span) {
  if (!found || !auto) return 0;
  const last = Math.max(...found.courses.map((c) => c.times_s.at(-1)));
  return Math.min(last / speed, SHARE * span);
}

// Where a signal is expected at the end of the law's horizon; empty without a prediction.
export function expected(signal) {
  const c = course(signal);
  return c ? `${number(c.values.at(-1), signal)} ${unit(signal)} in ${duration(c.times_s.at(-1))}`.replace("  ", " ") : "";
}

// The law's reasons for the next move of an MV.
export function reasons(signal) {
  const m = move(signal);
  if (!m) return "";
  if (Math.abs(m.move) < STANDS * (signal.high - signal.low)) return m.sentence;
  return `${m.sentence} (next move ${m.move > 0 ? "+" : ""}${figure(m.move)} ${unit(signal)})`.replace(" )", ")");
}

// The values of a course between two times, for the scale of its chart.
export function near(signal, low, high) {
  const c = course(signal);
  return c ? [Math.min(low, ...c.values), Math.max(high, ...c.values)] : [low, high];
}

const WORD = "prediction";

// Over the lines of a plot: the course, dashed, right of now. Where the word that names it ends; 0 where there is none.
export function draw(u, signal, kind, color) {
  const c = course(signal);
  const { ctx, bbox } = u;
  const begin = found ? u.valToPos(found.time, "x", true) : Infinity;
  const shown = c && begin < bbox.left + bbox.width - 2;
  u.root.parentElement?.setAttribute("data-ahead", shown ? c.values.length : 0); // for tests, which cannot read a canvas
  if (!shown) return 0;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, 0, bbox.width, bbox.top + bbox.height);
  ctx.clip();
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "left";
  ctx.fillStyle = ctx.strokeStyle = color("ink-2");
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([]); // uPlot leaves what its last line needed
  const [wide, right] = [ctx.measureText(WORD).width, bbox.left + bbox.width];
  const beside = begin + 4 * devicePixelRatio;
  const fits = beside + wide <= right; // else, on a phone, it stands inside, where no other word is
  ctx.fillText(WORD, fits ? beside : right - wide, bbox.top + (fits ? -5 : 12) * devicePixelRatio);
  const end = (fits ? beside : right - wide) + wide;
  u.root.parentElement?.setAttribute("data-word-room", Math.round((bbox.left + bbox.width - end) / devicePixelRatio)); // for tests
  ctx.beginPath();
  ctx.moveTo(begin, bbox.top);
  ctx.lineTo(begin, bbox.top + bbox.height);
  ctx.stroke();
  ctx.strokeStyle = color(kind);
  ctx.lineWidth = 1.5 * devicePixelRatio;
  ctx.setLineDash(DASH.map((v) => v * devicePixelRatio));
  ctx.beginPath();
  let before = null;
  c.values.forEach((v, k) => {
    const [x, y] = [u.valToPos(found.time + c.times_s[k] / speed, "x", true), u.valToPos(v, "y", true)];
    if (before === null) ctx.moveTo(x, y);
    else if (c.group === "mv") ctx.lineTo(x, before); // it stays until the next move
    ctx.lineTo(x, y);
    before = y;
  });
  if (c.group === "mv") ctx.lineTo(bbox.left + bbox.width, before);
  ctx.stroke();
  ctx.restore();
  return end;
}

// Whether the law can be asked what it would do, as far as is known, and whether it moves the plant now.
export const foresees = () => steers && !missing;
export const moves = () => auto;
