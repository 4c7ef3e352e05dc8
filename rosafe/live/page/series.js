// The newest columns of one picture, and the clock that all pictures scroll by.

const KEPT = 32; // seconds

export class Series {
  constructor(size, rate) {
    this.size = size;
    this.rate = rate;
    this.capacity = Math.max(16, Math.ceil(KEPT * rate));
    this.values = new Float32Array(size * this.capacity).fill(NaN);
    this.clear();
  }

  clear() {
    this.first = this.next = 0;
    this.zero = 0; // the time of the audio at which column 0 begins
    this.end = -Infinity;
  }

  // Takes a piece in; returns the columns [from, to) that are others now, and whether all before them are void.
  append(piece) {
    const after = piece.first + piece.count * piece.stride;
    let anew = false;
    if (piece.first < this.first || piece.first > this.next + this.capacity || after < this.next - 1 || !this.next) {
      this.first = this.next = piece.first;
      anew = true;
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
    return { from, to: after, anew };
  }

  #column(column) {
    const at = (column % this.capacity) * this.size;
    return this.values.subarray(at, at + this.size);
  }

  // The column at a time of the audio; null where there is none.
  at(time) {
    const column = Math.floor((time - this.zero) * this.rate);
    return column >= this.first && column < this.next ? this.#column(column) : null;
  }

  columnAt(time) {
    return (time - this.zero) * this.rate;
  }

  each(from, to, take) {
    const first = Math.max(this.first, Math.ceil(from));
    const last = Math.min(this.next, Math.floor(to));
    for (let column = first; column < last; column += 1) take(this.#column(column), column);
  }
}

// Blocks come a few times a second; the clock lags behind them by so little that pictures move without a jerk.
export class Clock {
  #notes = [];
  #last = new Map();
  #offset = null;
  #end = -Infinity;

  note(series, now) {
    const before = this.#last.get(series);
    this.#last.set(series, { end: series.end, now });
    if (series.end < this.#end - 5) this.reset();
    this.#end = Math.max(this.#end, series.end);
    const grown = before ? series.end - before.end : 0;
    if (!before || grown <= 0 || grown > 1.5 * (now - before.now) + 0.3) return; // what had been kept for us
    this.#notes.push({ now, offset: before.end - now });
    while (this.#notes[0].now < now - 4) this.#notes.shift();
  }

  reset() {
    this.#notes = [];
    this.#offset = null;
    this.#end = -Infinity;
    this.#last.clear();
  }

  // The time of the audio that the right edge shows; null before there is any.
  head(now) {
    if (!Number.isFinite(this.#end)) return null;
    const wanted = this.#notes.length ? Math.min(...this.#notes.map((note) => note.offset)) : this.#end - 0.4 - now;
    if (this.#offset === null || Math.abs(wanted - this.#offset) > 1.5) this.#offset = wanted;
    else this.#offset += (wanted - this.#offset) * 0.06;
    return Math.min(now + this.#offset, this.#end);
  }
}
