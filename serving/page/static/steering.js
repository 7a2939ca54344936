// The trends by keyboard and by touch. A finger that moves up or down scrolls the page (touch-action in page.css).

const CLOSER = 0.5;
const LEAST_PX = 8; // that a finger moves before it drags
const LEAST_APART = 24; // pixels between two fingers

// view: what is shown; changed(): it is another; read(by): the values at the next scan are wanted.
export function steer(box, view, { changed, read }) {
  const keys = {
    ArrowLeft: (far) => view.pan(far ? -5 : -1),
    ArrowRight: (far) => view.pan(far ? 5 : 1),
    "+": () => view.zoom(CLOSER),
    "=": () => view.zoom(CLOSER), // the same key without Shift
    "-": () => view.zoom(1 / CLOSER),
    Home: () => view.follow(),
    End: () => view.follow(),
  };
  const readers = { ",": -1, ".": 1 };
  box.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target !== box) return;
    if (readers[event.key]) read(readers[event.key]);
    else if (keys[event.key]) {
      keys[event.key](event.shiftKey);
      changed();
    } else return;
    event.preventDefault();
  });
  fingers(box, view, changed);
}

// The part under the fingers stays under them.
function fingers(box, view, changed) {
  const down = new Map(); // pointer -> x
  let began = null; // { first: x of the fingers, bounds, left, width, moves }

  const begin = (event) => {
    const over = event.target.closest(".u-over");
    const { left, width } = (over || box).getBoundingClientRect();
    began = { first: [...down.values()], bounds: view.bounds(), drawn: view.shown(), left, width, moves: down.size > 1 };
  };
  box.addEventListener("pointerdown", (event) => {
    if (event.pointerType !== "touch" || !event.target.closest(".u-over") || down.size > 1) return;
    down.set(event.pointerId, event.clientX);
    begin(event);
  });
  box.addEventListener("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    down.set(event.pointerId, event.clientX);
    const { first, bounds, drawn, left, width } = began;
    const x = [...down.values()];
    began.moves ||= Math.abs(x[0] - first[0]) > LEAST_PX;
    if (!began.moves) return;
    const [from, to] = bounds;
    const at = (px) => from + ((px - left) / width) * (drawn[1] - from); // when that was, as the gesture began
    if (x.length === 1) {
      const by = at(first[0]) - at(x[0]);
      if (to + by >= view.now()) view.follow(to - from);
      else view.look(from + by, to + by);
    } else {
      const apart = Math.max(LEAST_APART, Math.abs(x[1] - x[0]));
      const scale = Math.max(LEAST_APART, Math.abs(first[1] - first[0])) / apart;
      const [then, now] = [(first[0] + first[1]) / 2, (x[0] + x[1]) / 2];
      const begins = at(then) - ((now - left) / width) * scale * (to - from);
      view.look(begins, begins + scale * (to - from));
    }
    changed();
  });
  const end = (event) => {
    if (down.delete(event.pointerId) && down.size) begin(event); // the other finger goes on from here
  };
  for (const name of ["pointerup", "pointercancel"]) addEventListener(name, end);
}
