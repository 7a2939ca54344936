// Measurement noise: Gaussian, with a colour, the same for the same seed.

// Uniform in (0, 1): the generator "mulberry32", whose state is one number of 32 bits.
function uniform(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = Math.imul(state ^ (state >>> 15), state | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return (((t ^ (t >>> 14)) >>> 0) + 0.5) / 4294967296;
  };
}

// e(k) = phi e(k-1) + sqrt(1 - phi^2) w(k), e(0) = w(0), with w of standard deviation 1 and phi the colour of each PV.
export class Noise {
  constructor(colour, seed) {
    this.colour = colour;
    this.draw = uniform(seed);
    this.last = null;
  }

  next() {
    const fresh = this.colour.map(() => Math.sqrt(-2 * Math.log(this.draw())) * Math.cos(2 * Math.PI * this.draw()));
    const last = this.last;
    this.last = last ? fresh.map((w, i) => this.colour[i] * last[i] + Math.sqrt(1 - this.colour[i] ** 2) * w) : fresh;
    return this.last;
  }
}
