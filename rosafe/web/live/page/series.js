// The newest columns of one plot, and the clock by which all plots scroll.

const HISTORY_SECONDS = 32;

export class Series {
  constructor(size, rate) {
    this.size = size;
    this.rate = rate;
    this.capacity = Math.max(16, Math.ceil(HISTORY_SECONDS * rate));
    this.values = new Float32Array(size * this.capacity).fill(NaN);
    this.clear();
  }

  clear() {
    this.first = this.next = 0;
    this.zero = 0; // the time of the audio at which column 0 begins
    this.end = -Infinity;
  }

  // Append a piece of a message. Return the columns [from, to) that have changed, and whether the audio has restarted.
  append(piece) {
    const after = piece.first + piece.count * piece.stride;
    let restarted = false;
    if (piece.first < this.first || piece.first > this.next + this.capacity || after < this.next - 1 || !this.next) {
      this.first = this.next = piece.first;
      restarted = true;
    }
    const from = Math.min(this.next, piece.first);
    for (let column = this.next; column < piece.first; column += 1) this.#column(column).fill(NaN);
    for (let one = 0; one < piece.count; one += 1) {
      const source = piece.values.subarray(one * this.size, (one + 1) * this.size);
      for (let copy = 0; copy < piece.stride; copy += 1) this.#column(piece.first + one * piece.stride + copy).set(source);
    }
    this.next = Math.max(this.next, after);
    this.first = Math.max(this.first, this.next - this.capacity);
    this.end = piece.end;
    this.zero = piece.end - after / this.rate;
    return { from, to: after, restarted };
  }

  #column(column) {
    const at = (column % this.capacity) * this.size;
    return this.values.subarray(at, at + this.size);
  }

  // The column at a time of the audio, or null.
  at(time) {
    const column = Math.floor((time - this.zero) * this.rate);
    return column >= this.first && column < this.next ? this.#column(column) : null;
  }

  columnAt(time) {
    return (time - this.zero) * this.rate;
  }

  forEach(from, to, visit) {
    const first = Math.max(this.first, Math.ceil(from));
    const last = Math.min(this.next, Math.floor(to));
    for (let column = first; column < last; column += 1) visit(this.#column(column), column);
  }
}

// The time of the audio at the right edge of the plots (the head). Blocks arrive a few times per second; the clock is
// slightly late, so that the plots scroll smoothly.
export class Clock {
  #samples = [];
  #last = new Map();
  #offset = null;
  #end = -Infinity;

  observe(series, now) {
    const before = this.#last.get(series);
    this.#last.set(series, { end: series.end, now });
    if (series.end < this.#end - 5) this.reset();
    this.#end = Math.max(this.#end, series.end);
    const added = before ? series.end - before.end : 0;
    if (!before || added <= 0 || added > 1.5 * (now - before.now) + 0.3) return; // columns from before the subscription
    this.#samples.push({ now, offset: before.end - now });
    while (this.#samples[0].now < now - 4) this.#samples.shift();
  }

  reset() {
    this.#samples = [];
    this.#offset = null;
    this.#end = -Infinity;
    this.#last.clear();
  }

  // The time of the audio at the right edge, or null before the first column.
  head(now) {
    if (!Number.isFinite(this.#end)) return null;
    const target = this.#samples.length ? Math.min(...this.#samples.map((sample) => sample.offset)) : this.#end - 0.4 - now;
    if (this.#offset === null || Math.abs(target - this.#offset) > 1.5) this.#offset = target;
    else this.#offset += (target - this.#offset) * 0.06;
    return Math.min(now + this.#offset, this.#end);
  }
}
