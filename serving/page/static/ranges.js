// The ranges that operators have set, in the trends: as a band behind a signal's line, from when on they hold.
let places = new Map(); // name of an entry -> its place
let changes = []; // [time, values], the oldest first

// about.operated: since the loop began, as far as it keeps them.
export function describe(about) {
  places = new Map((about.operate || []).map((entry, i) => [entry.name, i]));
  changes = (about.operated || []).filter(([, values]) => values.length === places.size);
}

export function show(state) {
  const now = state.operate;
  if (!now || now.length !== places.size || !places.size) return;
  const last = changes.at(-1);
  if (!last || last[1].some((v, i) => v !== now[i])) changes.push([state.time, now]);
}

// [from, to, low, high] of a signal, where its range is narrower than the engineered one and it is in use.
export function bands(signal) {
  const [low, high, use] = ["low", "high", "use"].map((what) => places.get(`${signal.name}.${what}`));
  if (low === undefined || high === undefined || signal.high === undefined) return [];
  const made = [];
  changes.forEach(([from, v], i) => {
    const to = changes[i + 1]?.[0] ?? Infinity;
    if ((v[low] > signal.low || v[high] < signal.high) && (use === undefined || v[use] > 0)) made.push([from, to, v[low], v[high]]);
  });
  return made;
}

const NEAR = 0.1; // of a signal's range: an end that lies so near to what is drawn is drawn, too

// The ends of the present range that belong into a picture of the values from `low` to `high`.
export function near(signal, low, high) {
  const last = bands(signal).at(-1);
  if (!last || last[1] !== Infinity) return [low, high];
  const reach = NEAR * (signal.high - signal.low);
  const [first, end] = [last[2], last[3]];
  return [first < low && low - first <= reach ? first : low, end > high && end - high <= reach ? end : high];
}

// Behind the lines of a plot: the band, and a line at each end.
export function draw(u, signal, color) {
  const { ctx, bbox } = u;
  const found = bands(signal);
  u.root.parentElement?.setAttribute("data-bands", found.length); // for tests, which cannot read a canvas
  if (!found.length) return;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([]); // uPlot leaves what its last line needed
  for (const [from, to, low, high] of found) {
    const left = Math.max(bbox.left, u.valToPos(from, "x", true));
    const right = to === Infinity ? bbox.left + bbox.width : Math.min(bbox.left + bbox.width, u.valToPos(to, "x", true));
    if (right <= left) continue;
    const [top, bottom] = [u.valToPos(high, "y", true), u.valToPos(low, "y", true)];
    ctx.fillStyle = color("band-range");
    ctx.fillRect(left, top, right - left, bottom - top);
    ctx.strokeStyle = color("edge");
    ctx.beginPath();
    for (const y of [top, bottom]) {
      ctx.moveTo(left, y);
      ctx.lineTo(right, y);
    }
    ctx.stroke();
  }
  ctx.restore();
}
