// The time in each mode, behind the lines: HOLD hatched, SHADOW and MANUAL shaded, AUTO plain, a time without a scan
// darker; each with its word above.

const NO_RECORD = "no record";
const WIDTH = { word: 48, words: 64 }; // pixels that they need
export const ABOVE = 16; // pixels above the lines, where the words stand

// record: what data.js has.
export function bands(u, record, color) {
  const { ctx, bbox } = u;
  const end = bbox.left + bbox.width;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, 0, bbox.width, bbox.top + bbox.height);
  ctx.clip();
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "left"; // uPlot leaves what its axes needed
  ctx.textBaseline = "alphabetic";
  for (const [from, to, mode] of stretches(record)) {
    const left = Math.max(bbox.left, u.valToPos(from, "x", true));
    const right = Math.min(end, u.valToPos(to, "x", true));
    if (right > left) band(ctx, left, right, bbox, mode, color);
  }
  ctx.restore();
}

// [from, to, mode] one after the other; mode is empty where nothing was written down.
export function stretches({ modes, time, from, to, longest }) {
  if (!time.length) return from < to ? [[from, to, ""]] : [];
  const made = modes.map(([begin, mode], i) => [begin, i + 1 < modes.length ? modes[i + 1][0] : Infinity, mode]);
  const [first, last] = [time[0], time[time.length - 1]];
  if (first - from > longest) made.unshift([from, first, ""]);
  if (to - last > longest && made.length) {
    made[made.length - 1][1] = last;
    made.push([last, Infinity, ""]);
  }
  return made;
}

function band(ctx, left, right, bbox, mode, color) {
  if (mode !== "AUTO") {
    ctx.fillStyle = color(mode === "HOLD" ? "band-hold" : mode ? "band-other" : "band-none");
    ctx.fillRect(left, bbox.top, right - left, bbox.height);
  }
  if (mode === "HOLD") hatch(ctx, left, right, bbox, color("hatch"));
  if (right - left < (mode ? WIDTH.word : WIDTH.words) * devicePixelRatio) return;
  ctx.fillStyle = color("ink-2");
  ctx.fillText(mode || NO_RECORD, left, bbox.top - 5 * devicePixelRatio);
}

function hatch(ctx, left, right, bbox, stroke) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(left, bbox.top, right - left, bbox.height);
  ctx.clip();
  ctx.strokeStyle = stroke;
  ctx.lineWidth = devicePixelRatio;
  ctx.beginPath();
  for (let x = left - bbox.height; x < right; x += 9 * devicePixelRatio) {
    ctx.moveTo(x, bbox.top + bbox.height);
    ctx.lineTo(x + bbox.height, bbox.top);
  }
  ctx.stroke();
  ctx.restore();
}
