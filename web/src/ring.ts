// The newest samples of one variable, with their times.

/** Seconds by which a sample may be older than the newest; more: a clock was put back. */
export const CLOCK = 1;

export class Ring {
  private readonly times: Float64Array;
  private readonly values: Float64Array;
  private first = 0;
  private count = 0;

  /** Keeps up to `capacity` samples of `width` elements each. */
  constructor(
    readonly width: number,
    readonly capacity = 4096,
  ) {
    this.times = new Float64Array(capacity);
    this.values = new Float64Array(capacity * width);
  }

  get length(): number {
    return this.count;
  }
  get newest(): number {
    return this.count ? this.time(this.count - 1) : -Infinity;
  }

  time(k: number): number {
    return this.times[(this.first + k) % this.capacity]!;
  }
  value(k: number, element: number): number {
    return this.values[((this.first + k) % this.capacity) * this.width + element]!;
  }

  /**
   * Adds a sample; one that is not newer than the newest is ignored, but after a clock was put
   * back it takes the place of those after it. Returns whether it was added.
   */
  push(t: number, v: readonly (number | null)[]): boolean {
    if (this.count && t <= this.newest) {
      if (t > this.newest - CLOCK) return false;
      this.count = this.indexOf(t);
    }
    const place = (this.first + this.count) % this.capacity;
    if (this.count === this.capacity) this.first = (this.first + 1) % this.capacity;
    else this.count += 1;
    this.times[place] = t;
    for (let e = 0; e < this.width; e++) this.values[place * this.width + e] = v[e] ?? NaN;
    return true;
  }

  /** Puts earlier samples among those that are here already, by their times, each once. */
  putHistory(t: readonly number[], v: readonly (readonly (number | null)[])[]): void {
    const samples = t.map((time, k): [number, readonly (number | null)[]] => [time, v[k] ?? []]);
    for (let k = 0; k < this.count; k++) {
      samples.push([this.time(k), Array.from({ length: this.width }, (_, e) => this.value(k, e))]);
    }
    this.clear();
    for (const [time, sample] of samples.sort((a, b) => a[0] - b[0])) this.push(time, sample);
  }

  copy(): Ring {
    const made = new Ring(this.width, this.capacity);
    made.times.set(this.times);
    made.values.set(this.values);
    made.first = this.first;
    made.count = this.count;
    return made;
  }

  clear(): void {
    this.first = 0;
    this.count = 0;
  }

  /** Returns the place of the first sample at `t` or later; `length` if there is none. */
  indexOf(t: number): number {
    let low = 0,
      high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time(middle) < t) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** Returns times and one element between two times, with one sample before and after. */
  between(element: number, from: number, to: number): [number[], (number | null)[]] {
    const times: number[] = [],
      values: (number | null)[] = [];
    for (let k = Math.max(0, this.indexOf(from) - 1); k < this.count; k++) {
      const t = this.time(k),
        v = this.value(k, element);
      times.push(t);
      values.push(Number.isNaN(v) ? null : v);
      if (t > to) break;
    }
    return [times, values];
  }
}
