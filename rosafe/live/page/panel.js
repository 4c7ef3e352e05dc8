// One panel: a picture over time with its axes, colour bar and read-out.

import { colours, roundUp, ticks } from "./colours.js";
import { Series } from "./series.js";
import { el, hertz, number, quantity, tick } from "./ui.js";

// In units of the letters' size, which grows on a wall.
const LEFT = 4.5;
const RIGHT = 5.6;
const TOP = 7;
const BOTTOM = 1.75;
const GAP = 12; // between the ears
const EARS = ["left ear", "right ear"];
const FREQUENCIES = [20, 50, 100, 200, 500, 1000, 2000, 4000, 8000, 16000, 32000];
const TWO_SIDED = new Set(["ild", "itd", "gabor"]);
const SIDES = { ild: "above 0: louder on the right", itd: "above 0: earlier on the right" };
const RANGE_DB = 60;
const GROUNDS = { magma: "#08060f", deep: "#0a0c18", viridis: "#1c0424" }; // where there is nothing: as dark as their least
const TITLES = {
  input: "Input", preProc: "Pre-processed sound", gammatone: "Filterbank", ihc: "Inner hair cells", ratemap: "Cochleagram",
  ild: "Interaural level difference", itd: "Interaural time difference", ic: "Interaural coherence",
  crossCorrelation: "Cross-correlation", autocorrelation: "Autocorrelation", pitch: "Pitch",
  amsFeatures: "Amplitude modulation", adaptation: "Adaptation", gabor: "Gabor features", precedence: "Precedence",
  spectralFeatures: "Spectral features", onsetStrength: "Onset strength", offsetStrength: "Offset strength",
  onsetMap: "Onsets", offsetMap: "Offsets", moc: "Medial olivocochlear reflex",
};

export function title(kind) {
  return TITLES[kind] ?? kind;
}

export class Panel {
  // key: what the server is asked for; events: what the user does with the panel
  constructor(key, events) {
    this.key = key;
    this.view = null;
    this.series = null;
    this.direction = null; // of a cross-correlation: { view, series }
    this.range = null;
    this.shrink = 0;
    this.problem = "";
    this.cursor = null; // { x, y } in CSS pixels
    this.heading = el("h2", { text: "" });
    this.of = el("span", { class: "of" });
    this.reading = el("span", { class: "read", "aria-live": "off" });
    this.choice = el("select", { "aria-label": "channel", hidden: true, onchange: () => events.choose(this, Number(this.choice.value)) });
    this.part = el("select", { "aria-label": "part", hidden: true, onchange: () => events.turn(this, Number(this.part.value)) });
    this.canvas = el("canvas", { role: "img", tabindex: "0" });
    const close = el("button", { class: "quiet", title: "Close this picture", "aria-label": "close", text: "✕", onclick: () => events.close(this) });
    this.element = el(
      "article", { class: "panel" },
      el("div", { class: "head" }, this.heading, this.of, this.reading, this.part, this.choice, close), this.canvas,
    );
    this.canvas.addEventListener("pointermove", (event) => this.#point(event, events));
    this.canvas.addEventListener("pointerdown", (event) => this.#point(event, events));
    this.canvas.addEventListener("pointerleave", () => { this.cursor = null; events.point(null); });
    this.canvas.addEventListener("keydown", (event) => this.#step(event, events));
  }

  #point(event, events) {
    const box = this.canvas.getBoundingClientRect();
    this.cursor = { x: event.clientX - box.left, y: event.clientY - box.top };
    events.point(this.cursor.x);
  }

  #step(event, events) {
    const move = { ArrowLeft: [-4, 0], ArrowRight: [4, 0], ArrowUp: [0, -4], ArrowDown: [0, 4] }[event.key];
    if (!move) return;
    event.preventDefault();
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const at = this.cursor ?? { x: width / 2, y: height / 2 };
    this.cursor = { x: Math.max(0, Math.min(width, at.x + move[0])), y: Math.max(0, Math.min(height, at.y + move[1])) };
    events.point(this.cursor.x);
  }

  // What the server says of the view.
  describe(view, kinds) {
    const fresh = !this.view || this.view.number !== view.number;
    this.view = view;
    this.problem = "";
    if (fresh) {
      this.series = new Series(view.ears * view.rows, view.rate);
      this.images = view.mode === "heat" ? Array.from({ length: view.ears }, () => picture(this.series.capacity, view.rows)) : [];
      this.range = null;
    }
    this.canvas.classList.toggle("tall", view.ears > 1 && view.mode !== "line");
    this.canvas.dataset.name = view.name;
    this.canvas.dataset.kind = view.kind;
    this.element.classList.toggle("wide", view.kind === "ratemap");
    this.heading.textContent = title(view.kind) + (kinds[view.kind]?.parts.length > 1 ? `: ${view.partName}` : "");
    this.of.textContent = view.kind in SIDES ? `${view.name} · ${SIDES[view.kind]}` : view.name;
    this.of.title = view.doc;
    this.canvas.setAttribute("aria-label", `${this.heading.textContent} of ${view.name} over time`);
    this.#offer(view, kinds);
  }

  #offer(view, kinds) {
    const parts = kinds[view.kind]?.parts ?? [];
    this.part.hidden = parts.length < 2;
    this.part.replaceChildren(...parts.map((part, index) => el("option", { value: String(index), text: part.name, selected: index === view.part })));
    this.choice.hidden = !view.choices.length;
    const options = view.choices.map((choice, index) =>
      el("option", { value: String(index), text: typeof choice === "string" ? choice : hertz(choice), selected: index === view.row }));
    if (view.mode === "heat") options.unshift(el("option", { value: "-1", text: "mean over channels", selected: view.row < 0 }));
    if (view.choices.length) this.choice.replaceChildren(...options);
  }

  take(piece) {
    const { from, to, anew } = this.series.append(piece);
    if (anew) for (const image of this.images) image.clear();
    if (this.range && this.view.mode === "heat") this.#paint(from, to);
  }

  // --- colours ---

  #map(theme) {
    if (this.view.mode !== "heat") return "";
    if (this.#twoSided()) return theme.dark ? "darkSides" : "lightSides";
    if (this.view.kind === "crossCorrelation" || this.view.partName === "cc") return "deep";
    return this.view.level ? "magma" : "viridis";
  }

  #twoSided() {
    return TWO_SIDED.has(this.view.kind) || TWO_SIDED.has(this.view.partName);
  }

  #paint(from, to) {
    const { ears, rows } = this.view;
    const table = colours(this.map);
    const { low, high } = this.range;
    const scale = 255 / (high - low || 1);
    for (let ear = 0; ear < ears; ear += 1) {
      const image = this.images[ear];
      this.series.each(from, to, (column, index) => {
        const pixels = image.pixels;
        for (let row = 0; row < rows; row += 1) {
          const value = column[ear * rows + row];
          const step = Math.max(0, Math.min(255, Math.round((value - low) * scale)));
          pixels[rows - 1 - row] = Number.isNaN(value) ? 0 : table[step];
        }
        image.put(index % this.series.capacity);
      });
    }
  }

  // Limits of the numbers that are to be seen, as round numbers; they widen at once and narrow after a while.
  fit(head, span, theme, now) {
    const { view, series } = this;
    if (!view || !series.next) return;
    const seen = [];
    const from = series.columnAt(head - span);
    const to = series.columnAt(head) + 1;
    const thin = Math.max(1, Math.floor(((to - from) * series.size) / 6000));
    let count = 0;
    series.each(from, to, (column) => {
      for (const value of column) if (Number.isFinite(value) && (count += 1) % thin === 0) seen.push(value);
    });
    if (!seen.length) return;
    seen.sort((a, b) => a - b);
    const part = (share) => seen[Math.min(seen.length - 1, Math.floor(share * seen.length))];
    let low = part(0.01);
    let high = part(0.995);
    if (view.mode === "wave") {
      high = roundUp(Math.max(Math.abs(seen[0]), Math.abs(seen.at(-1)), 1e-6));
      low = -high;
    } else if (view.level) {
      high = Math.ceil(part(0.998) / 5) * 5;
      low = high - RANGE_DB;
    } else if (this.#twoSided()) {
      high = roundUp(Math.max(Math.abs(part(0.02)), Math.abs(part(0.98)), view.unit === "dB" ? 5 : 1e-5));
      low = -high;
    } else if (["crossCorrelation", "ic", "autocorrelation"].includes(view.kind) || view.partName === "cc") {
      high = 1;
      low = Math.max(-1, Math.min(0.95, Math.floor(low * 10) / 10));
    } else if (view.mode === "line") {
      const room = (seen.at(-1) - seen[0]) * 0.08 || Math.abs(high) * 0.1 || 1;
      const steps = ticks(seen[0] - room, seen.at(-1) + room, 5);
      const step = steps[1] - steps[0] || 1;
      low = steps[0] - step;
      high = steps.at(-1) + step;
      if (seen[0] >= 0) low = Math.max(0, low);
    } else {
      if (low >= 0 && low < 0.5 * high) low = 0;
      high = low + roundUp(high - low || 1);
    }
    const map = this.#map(theme);
    const old = this.range;
    const wider = !old || high > old.high || low < old.low;
    if (wider) this.shrink = now;
    if (map !== this.map || wider || (now - this.shrink > 4 && (high !== old.high || low !== old.low))) {
      this.map = map;
      this.range = { low, high };
      this.shrink = now;
      if (view.mode === "heat") this.#paint(series.first, series.next);
    }
  }

  // --- drawing ---

  draw(head, span, theme, pointed) {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const letter = theme.letter;
    this.letter = letter;
    pen.font = `${letter}px ${theme.font}`;
    const { view } = this;
    const bottom = BOTTOM * letter;
    const plots = view && view.mode !== "line" ? view.ears : 1;
    const tall = (height - TOP - bottom - GAP * (plots - 1)) / plots;
    const boxes = Array.from({ length: plots }, (_, ear) => ({ x: LEFT * letter, y: TOP + ear * (tall + GAP), w: width - (LEFT + RIGHT) * letter, h: tall }));
    this.boxes = boxes;
    for (const box of boxes) {
      pen.fillStyle = GROUNDS[this.map] ?? theme.plot;
      pen.fillRect(box.x, box.y, box.w, box.h);
    }
    if (!view || head === null || !this.range) {
      this.#say(pen, boxes[0], theme, this.problem || (view ? "waiting for sound" : "waiting"));
      return;
    }
    this.head = head;
    this.span = span;
    boxes.forEach((box, ear) => {
      pen.save();
      pen.beginPath();
      pen.rect(box.x, box.y, box.w, box.h);
      pen.clip();
      if (view.mode === "heat") this.#heat(pen, box, ear, head, span, theme);
      else if (view.mode === "wave") this.#wave(pen, box, ear, head, span, theme);
      else this.#lines(pen, box, head, span, theme);
      pen.restore();
      this.#upright(pen, box, theme);
      if (plots > 1) this.#tag(pen, box, EARS[ear]);
    });
    this.#across(pen, boxes.at(-1), span, theme);
    if (view.mode === "heat") this.#bar(pen, boxes, theme);
    this.#mark(pen, boxes, theme, pointed);
    if (this.problem) this.#say(pen, boxes[0], theme, this.problem);
    else if (canvas.title) canvas.title = "";
    const [box] = boxes;
    canvas.dataset.plot = JSON.stringify({
      x: box.x * ratio, y: box.y * ratio, w: box.w * ratio, h: box.h * ratio, from: head - span, to: head,
      ...this.range, first: view.along[0], last: view.along.at(-1),
    });
  }

  #say(pen, box, theme, text) {
    if (this.canvas.title !== text) this.canvas.title = text;
    pen.font = `${1.2 * theme.letter}px ${theme.font}`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    const wide = pen.measureText(text).width + 24;
    pen.fillStyle = theme.surface;
    pen.globalAlpha = 0.85;
    pen.fillRect(box.x + box.w / 2 - wide / 2, box.y + box.h / 2 - 14, wide, 28);
    pen.globalAlpha = 1;
    pen.fillStyle = theme.muted;
    pen.fillText(text, box.x + box.w / 2, box.y + box.h / 2);
    pen.font = `${theme.letter}px ${theme.font}`;
  }

  #tag(pen, box, text) {
    pen.textAlign = "left";
    pen.textBaseline = "top";
    const wide = pen.measureText(text).width;
    pen.fillStyle = "rgba(8, 10, 14, 0.6)";
    pen.fillRect(box.x + 6, box.y + 5, wide + 10, this.letter + 6);
    pen.fillStyle = "#e8ebef";
    pen.fillText(text, box.x + 11, box.y + 8);
  }

  #heat(pen, box, ear, head, span, theme) {
    const { series } = this;
    const image = this.images[ear];
    const perColumn = box.w / (span * series.rate);
    const left = series.columnAt(head - span);
    const first = Math.max(series.first, Math.floor(left));
    const last = Math.min(series.next, Math.ceil(series.columnAt(head)) + 1);
    pen.imageSmoothingEnabled = false;
    for (let from = first; from < last; ) {
      const place = from % series.capacity;
      const count = Math.min(last - from, series.capacity - place);
      pen.drawImage(image.canvas, place, 0, count, image.rows, box.x + (from - left) * perColumn, box.y, count * perColumn, box.h);
      from += count;
    }
    if (this.direction?.series?.next) this.#track(pen, box, head, span, theme);
  }

  #height(value, box) {
    const { along } = this.view;
    const half = along.length > 1 ? (along[1] - along[0]) / 2 : 0.5;
    const low = along[0] - half;
    return box.y + box.h * (1 - (value - low) / (along.at(-1) + half - low));
  }

  #track(pen, box, head, span, theme) {
    const { series, view } = this.direction;
    pen.lineWidth = 1;
    pen.strokeStyle = "rgba(255, 255, 255, 0.16)";
    pen.fillStyle = "rgba(255, 255, 255, 0.85)";
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    const ahead = this.#height(view.lags[view.azimuths.indexOf(0)] ?? 0, box);
    for (const [index, azimuth] of view.azimuths.entries()) {
      const y = this.#height(view.lags[index], box);
      const close = Math.abs(y - this.#height(view.lags[view.azimuths.indexOf(Math.sign(azimuth) * 90)], box)) < 17 || Math.abs(y - ahead) < 17;
      if (azimuth % 45 || (Math.abs(azimuth) === 45 && close)) continue;
      pen.beginPath();
      pen.moveTo(box.x, y);
      pen.lineTo(box.x + box.w, y);
      pen.stroke();
      const text = azimuth === 0 ? "ahead" : `${Math.abs(azimuth)}° ${azimuth > 0 ? "right" : "left"}`;
      pen.save();
      pen.lineWidth = 3;
      pen.strokeStyle = "rgba(8, 10, 20, 0.6)";
      pen.strokeText(text, box.x + 7, Math.max(box.y + 8, Math.min(box.y + box.h - 8, y + (azimuth < 0 ? 8 : -8))));
      pen.restore();
      pen.fillText(text, box.x + 7, Math.max(box.y + 8, Math.min(box.y + box.h - 8, y + (azimuth < 0 ? 8 : -8))));
    }
    pen.fillStyle = theme.track;
    const perSecond = box.w / span;
    const wide = Math.max(2, perSecond / series.rate);
    series.each(series.columnAt(head - span), series.columnAt(head) + 1, ([lag], column) => {
      if (Number.isFinite(lag)) pen.fillRect(box.x + (series.zero + (column + 0.5) / series.rate - head + span) * perSecond - wide / 2, this.#height(lag, box) - 1.5, wide, 3);
    });
  }

  #level(value, box) {
    const { low, high } = this.range;
    return box.y + box.h * (1 - (value - low) / (high - low));
  }

  #wave(pen, box, ear, head, span, theme) {
    const { series } = this;
    const perColumn = box.w / (span * series.rate);
    const left = series.columnAt(head - span);
    pen.fillStyle = ear ? theme.right : theme.left;
    series.each(left - 1, left + span * series.rate + 1, (column, index) => {
      const low = column[ear * 2];
      const high = column[ear * 2 + 1];
      if (Number.isNaN(low)) return;
      const top = this.#level(high, box);
      pen.fillRect(box.x + (index - left) * perColumn, top, Math.max(1, perColumn), Math.max(1, this.#level(low, box) - top));
    });
  }

  #lines(pen, box, head, span, theme) {
    const { series, view } = this;
    const perColumn = box.w / (span * series.rate);
    const left = series.columnAt(head - span);
    for (let ear = 0; ear < view.ears; ear += 1) {
      pen.strokeStyle = pen.fillStyle = ear ? theme.right : theme.left;
      pen.lineWidth = 1.8;
      pen.lineJoin = "round";
      pen.beginPath();
      let before = false;
      series.each(left - 1, left + span * series.rate + 1, (column, index) => {
        const value = column[ear];
        const x = box.x + (index + 0.5 - left) * perColumn;
        const y = this.#level(value, box);
        if (Number.isFinite(value)) {
          if (before) pen.lineTo(x, y);
          else {
            pen.moveTo(x, y);
            pen.fillRect(x - 1.5, y - 1.5, 3, 3);
          }
        }
        before = Number.isFinite(value);
      });
      pen.stroke();
    }
    if (view.ears > 1) {
      pen.textBaseline = "top";
      pen.textAlign = "left";
      EARS.forEach((name, ear) => {
        pen.fillStyle = ear ? theme.right : theme.left;
        pen.fillText(name, box.x + 8 + ear * 6 * this.letter, box.y + 6);
      });
    }
  }

  // --- axes ---

  #upright(pen, box, theme) {
    const { view } = this;
    pen.fillStyle = theme.muted;
    pen.strokeStyle = theme.grid;
    pen.lineWidth = 1;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    let last = Infinity;
    const label = (y, text) => {
      if (y < box.y - 1 || y > box.y + box.h + 1 || Math.abs(last - y) < 15) return;
      last = y;
      pen.fillText(text, box.x - 7, Math.max(box.y + 5, Math.min(box.y + box.h - 5, y)));
      pen.beginPath();
      pen.moveTo(box.x - 4, y);
      pen.lineTo(box.x, y);
      pen.stroke();
    };
    if (view.mode !== "heat") {
      for (const value of ticks(this.range.low, this.range.high, box.h / 28)) {
        const y = this.#level(value, box);
        label(y, tick(value));
        pen.beginPath();
        pen.moveTo(box.x, y);
        pen.lineTo(box.x + box.w, y);
        pen.stroke();
      }
      if (view.unit) this.#unit(pen, box, view.unit);
    } else if (view.axis === "lag") {
      for (const lag of ticks(view.along[0] * 1e3, view.along.at(-1) * 1e3, box.h / 28)) label(this.#height(lag / 1e3, box), tick(lag));
      this.#unit(pen, box, "ms");
    } else if (typeof view.along[0] === "number" && ["channel", "filter"].includes(view.axis)) {
      const wanted = view.axis === "channel" ? FREQUENCIES : [...view.along];
      for (const frequency of wanted) {
        const row = rowOf(view.along, frequency);
        if (row !== null) label(box.y + box.h * (1 - (row + 0.5) / view.rows), frequency >= 1000 ? `${Number((frequency / 1000).toPrecision(2))}k` : tick(frequency));
      }
      this.#unit(pen, box, "Hz");
    } else {
      const step = Math.max(1, Math.ceil(view.rows / (box.h / 18)));
      for (let row = 0; row < view.rows; row += step) label(box.y + box.h * (1 - (row + 0.5) / view.rows), typeof view.along[row] === "number" ? view.along[row].toFixed(0) : String(view.along[row]).slice(0, 8));
    }
  }

  #unit(pen, box, text) {
    pen.save();
    pen.translate(0.8 * this.letter, box.y + box.h / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText(text, 0, 0);
    pen.restore();
  }

  #across(pen, box, span, theme) {
    pen.fillStyle = theme.muted;
    pen.strokeStyle = theme.grid;
    pen.textBaseline = "top";
    const most = Math.max(2, Math.min(10, box.w / 70));
    for (const ago of ticks(0, span, most)) {
      const x = box.x + box.w * (1 - ago / span);
      pen.textAlign = ago === 0 ? "right" : x < box.x + 16 ? "left" : "center";
      pen.fillText(ago === 0 ? "0 s" : `−${tick(ago)} s`, x, box.y + box.h + 5);
      pen.beginPath();
      pen.moveTo(x, box.y + box.h);
      pen.lineTo(x, box.y + box.h + 4);
      pen.stroke();
    }
  }

  #bar(pen, boxes, theme) {
    const x = boxes[0].x + boxes[0].w + 10;
    const y = boxes[0].y;
    const h = boxes.at(-1).y + boxes.at(-1).h - y;
    const table = colours(this.map);
    for (let step = 0; step < h; step += 1) {
      const colour = table[Math.round(255 * (1 - step / h))];
      pen.fillStyle = `rgb(${colour & 255}, ${(colour >> 8) & 255}, ${(colour >> 16) & 255})`;
      pen.fillRect(x, y + step, 9, 1.5);
    }
    pen.fillStyle = theme.muted;
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    const { low, high } = this.range;
    const scale = this.view.unit === "s" ? 1e3 : 1;
    for (const value of ticks(low * scale, high * scale, Math.min(6, h / 34))) {
      const at = y + h * (1 - (value / scale - low) / (high - low));
      pen.fillText(tick(value), x + 13, Math.max(y + 5, Math.min(y + h - 5, at)));
    }
    pen.textAlign = "right";
    pen.textBaseline = "top";
    const unit = this.view.unit === "s" ? "ms" : this.view.unit;
    if (unit) pen.fillText(unit, x + RIGHT * this.letter - 12, boxes.at(-1).y + boxes.at(-1).h + 5);
  }

  // --- the cursor ---

  #mark(pen, boxes, theme, pointed) {
    const { x, w } = boxes[0];
    this.reading.textContent = "";
    if (pointed === null || pointed < x || pointed > x + w) return;
    pen.strokeStyle = theme.cursor;
    pen.lineWidth = 1;
    const bottom = boxes.at(-1).y + boxes.at(-1).h;
    pen.beginPath();
    pen.moveTo(Math.round(pointed) + 0.5, boxes[0].y);
    pen.lineTo(Math.round(pointed) + 0.5, bottom);
    if (this.cursor) {
      pen.moveTo(x, Math.round(this.cursor.y) + 0.5);
      pen.lineTo(x + w, Math.round(this.cursor.y) + 0.5);
    }
    pen.stroke();
    this.reading.textContent = this.read(pointed);
  }

  // What the numbers are at a place of the plot.
  read(x) {
    const { boxes, view, series, head, span, cursor } = this;
    const ago = (span * (boxes[0].x + boxes[0].w - x)) / boxes[0].w;
    const time = head - ago;
    const column = series.at(time);
    const words = [`${time.toFixed(2)} s`];
    if (!column) return [...words, "none"].join(" · ");
    if (view.mode === "line") words.push(...Array.from(column, (value, ear) => (view.ears > 1 ? `${"LR"[ear]} ` : "") + quantity(value, view.unit)));
    else if (view.mode === "wave") words.push(...[0, 1].slice(0, view.ears).map((ear) => `${"LR"[ear]} ${number(Math.max(Math.abs(column[2 * ear]), Math.abs(column[2 * ear + 1])))}`));
    else if (cursor) {
      const ear = boxes.findIndex((box) => cursor.y >= box.y && cursor.y <= box.y + box.h);
      if (ear < 0) return words[0];
      const row = Math.min(view.rows - 1, Math.floor((1 - (cursor.y - boxes[ear].y) / boxes[ear].h) * view.rows));
      const along = view.along[Math.max(0, row)];
      words.push(view.axis === "lag" ? quantity(along, "s") : typeof along === "number" && view.axis !== "feature" ? hertz(along) : String(along));
      words.push(quantity(column[ear * view.rows + row], view.unit));
    }
    if (this.direction?.series?.next) {
      const found = this.direction.series.at(time);
      const text = found ? direction(this.direction.view, found[0]) : "";
      if (text) words.push(text);
    }
    return words.join(" · ");
  }
}

// A lag as a direction in words; empty where there is none.
export function direction(view, lag) {
  if (!Number.isFinite(lag) || !view.lags.length) return "";
  const { lags, azimuths } = view;
  let at = lags.findIndex((one) => one >= lag);
  if (at === 0 || at < 0) return azimuthText(at === 0 ? azimuths[0] : azimuths.at(-1));
  const part = (lag - lags[at - 1]) / (lags[at] - lags[at - 1] || 1);
  return azimuthText(azimuths[at - 1] + part * (azimuths[at] - azimuths[at - 1]));
}

function azimuthText(azimuth) {
  const whole = Math.round(azimuth);
  return whole === 0 ? "ahead" : `${Math.abs(whole)}° ${whole > 0 ? "right" : "left"}`;
}

// Where a frequency lies among those of the rows, which rise.
function rowOf(along, frequency) {
  if (along.length < 2) return along[0] === frequency ? 0 : null;
  const at = along.findIndex((one) => one >= frequency);
  if (at < 0) return frequency <= along.at(-1) * 1.04 ? along.length - 1 : null;
  if (at === 0) return frequency >= along[0] * 0.96 ? 0 : null;
  return at - 1 + Math.log(frequency / along[at - 1]) / Math.log(along[at] / along[at - 1]);
}

// A ring of columns as a canvas.
function picture(width, rows) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = rows;
  const pen = canvas.getContext("2d");
  const data = pen.createImageData(1, rows);
  return {
    canvas, rows, pixels: new Uint32Array(data.data.buffer),
    put: (column) => pen.putImageData(data, column, 0),
    clear: () => pen.clearRect(0, 0, width, rows),
  };
}
