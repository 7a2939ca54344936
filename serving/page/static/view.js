// The time that the trends show: the newest `span` seconds, or a time that the operator chose. A time that reaches
// now is live again.

const SHORTEST = 2; // seconds
const LONGEST = 400 * 86400; // what the server draws at once
const STEP = 0.2; // of what is shown, by which a key or a button goes

export class View {
  // ahead(span): the seconds after now that are drawn while it is live.
  constructor(span, now, ahead = () => 0) {
    this.span = span;
    this.now = now;
    this.ahead = ahead;
    this.chosen = null; // [from, to]
  }

  get live() {
    return this.chosen === null;
  }

  // With the time ahead that is drawn beside the newest scans.
  shown() {
    const [from, to] = this.bounds();
    return [from, this.live ? to + this.ahead(to - from) : to];
  }

  bounds() {
    const now = this.now();
    return this.chosen || [now - this.span, now];
  }

  follow(span = this.span) {
    this.span = span;
    this.chosen = null;
  }

  stop() {
    this.chosen = this.bounds();
  }

  look(from, to) {
    const width = Math.min(LONGEST, Math.max(SHORTEST, to - from));
    const middle = (from + to) / 2;
    if (middle + width / 2 >= this.now()) this.follow(width);
    else this.chosen = [middle - width / 2, middle + width / 2];
  }

  pan(steps) {
    const [from, to] = this.bounds();
    const by = steps * STEP * (to - from);
    if (this.live && by > 0) return;
    if (to + by >= this.now()) this.follow(to - from);
    else this.look(from + by, to + by);
  }

  // About the newest scan while it is live, else about the middle.
  zoom(factor) {
    const [from, to] = this.bounds();
    const width = Math.min(LONGEST, Math.max(SHORTEST, factor * (to - from)));
    if (this.live) return this.follow(width);
    const middle = (from + to) / 2;
    this.look(middle - width / 2, middle + width / 2);
  }
}
