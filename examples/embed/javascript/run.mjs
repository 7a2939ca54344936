// A loop on an absolute time grid, and a made-up plant to put yours in place of.
import { wordsOf } from "./controller.mjs";

const middle = (s) => {
  const at = (s.low + s.high) / 2;
  return s.values ? s.values.reduce((a, b) => (Math.abs(b - at) < Math.abs(a - at) ? b : a)) : at;
};

// Scan once a period at start + k period: lateness never becomes drift, and a period that has passed whole is skipped.
// now() gives seconds that only grow, sleep(seconds) a promise, plant {read(), write(mv)}, seen(command) gets each command.
// Whatever read and write return or throw, the loop goes on; it waits for both, so give them a limit of time.
export async function run(loop, plant, { scans, now, sleep, period = loop.controller.manifest.period_s, seen = () => {} }) {
  const start = now();
  for (let k = 0; k < scans; k++) {
    // A timer may fire early.
    for (let wait; (wait = start + k * period - now()) > 0; ) await sleep(wait);
    let late = now() - (start + k * period);
    const missed = Math.floor(Math.max(0, late) / period);
    if (missed) {
      loop.gap(missed);
      k += missed;
      late -= missed * period;
    }
    let sample = null;
    try {
      sample = await plant.read();
    } catch {
      // the loop holds the MV and names the fault
    }
    let command = await loop.scan(sample);
    try {
      if (command.mv) await plant.write([...command.mv]);
    } catch (error) {
      command = loop.unwritten(`the plant cannot be written: ${wordsOf(error)}`);
    }
    seen({ k, late, ...command });
  }
}

// Stands for your plant until you read yours: the PVs wander over their ranges, the MV is read back as it was written.
export class MadeUpPlant {
  constructor(manifest) {
    Object.assign(this, { m: manifest, mv: manifest.mv.map(middle), k: 0 }); // where its actuators stand
  }

  read() {
    const at = (this.k++ % 10) / 10;
    const pv = this.m.pv.map((s) => s.low + (s.high - s.low) * at);
    return { pv, dv: this.m.dv.map(middle), mv_applied: [...this.mv], age_s: 0 };
  }

  write(mv) {
    this.mv = mv;
  }
}

// Set points to begin with; give those of your plant.
export const start = (manifest) => ({ sp: manifest.sp.map(middle) });

// NAME=VALUE words of what operators may change, as y0.low=40, together.
export const operated = (words) =>
  Object.fromEntries(
    words.map((text) => {
      const [, name, value] = /^(.+)=([^=]+)$/.exec(text) ?? [];
      if (!name || !value.trim() || !Number.isFinite(Number(value))) throw new Error(`${text} is not NAME=VALUE`);
      return [name, Number(value)];
    })
  );
