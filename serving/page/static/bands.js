// The time in each mode, behind the lines: HOLD hatched, SHADOW and MANUAL shaded, AUTO plain; each with its word. A
// time without a scan is ruled and says so.

const NO_RECORD = "no record";
const LEAST_TEXT = 44; // pixels that a word needs

// record: what data.js has.
export function bands(u, record, color) {
  const { ctx, bbox } = u;
  const end = bbox.left + bbox.width;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
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
  if (!mode) rule(ctx, left, right, bbox, color("line"));
  const words = mode || NO_RECORD;
  if (right - left > (mode ? 1 : 1.5) * LEAST_TEXT * devicePixelRatio) {
    const [x, y] = [left + 4 * devicePixelRatio, bbox.top + 12 * devicePixelRatio];
    if (!mode) {
      ctx.fillStyle = color("band-none"); // no rule runs through the words
      ctx.fillRect(left, bbox.top, ctx.measureText(words).width + 8 * devicePixelRatio, 16 * devicePixelRatio);
    }
    ctx.fillStyle = color("ink-2");
    ctx.fillText(words, x, y);
  }
}

function hatch(ctx, left, right, bbox, stroke) {
  strokes(ctx, left, right, bbox, stroke, () => {
    for (let x = left - bbox.height; x < right; x += 9 * devicePixelRatio) {
      ctx.moveTo(x, bbox.top + bbox.height);
      ctx.lineTo(x + bbox.height, bbox.top);
    }
  });
}

function rule(ctx, left, right, bbox, stroke) {
  strokes(ctx, left, right, bbox, stroke, () => {
    for (let y = bbox.top + 4; y < bbox.top + bbox.height; y += 7 * devicePixelRatio) {
      ctx.moveTo(left, y);
      ctx.lineTo(right, y);
    }
  });
}

function strokes(ctx, left, right, bbox, stroke, draw) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(left, bbox.top, right - left, bbox.height);
  ctx.clip();
  ctx.strokeStyle = stroke;
  ctx.lineWidth = devicePixelRatio;
  ctx.beginPath();
  draw();
  ctx.stroke();
  ctx.restore();
}
