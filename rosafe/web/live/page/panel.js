// One panel: a plot over time with axes, colour bar and readout.

import { columnImage, drawColumns, message, prepare, timeAxis } from "./axes.js";
import { colours, roundUp, ticks } from "./colours.js";
import { Series } from "./series.js";
import { el, hertz, number, quantity, tick } from "./ui.js";

// Margins of a plot: TOP in pixels, the others in units of the font size, which is larger on large screens.
const LEFT = 4.5;
const RIGHT = 5.6;
const TOP = 7;
const BOTTOM = 1.75;
const GAP = 12; // pixels between the ears
const EARS = ["left ear", "right ear"];
const FREQUENCIES = [20, 50, 100, 200, 500, 1000, 2000, 4000, 8000, 16000, 32000];
const TWO_SIDED = new Set(["ild", "itd", "gabor"]);
const SIDES = { ild: "above 0: louder on the right", itd: "above 0: earlier on the right" };
const RANGE_DB = 60;
const BACKGROUNDS = { magma: "#08060f", deep: "#0a0c18", viridis: "#1c0424" }; // of missing values: similar to the darkest colour
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
  // key: the view, as in requests to the server; plots: handles the controls of the panel
  constructor(key, plots) {
    this.key = key;
    this.view = null;
    this.series = null;
    this.range = null;
    this.rangeSetAt = 0;
    this.problem = "";
    this.cursor = null; // { x, y } in CSS pixels
    this.heading = el("h2", { text: "" });
    this.subtitle = el("span", { class: "subtitle" });
    this.readout = el("span", { class: "read", "aria-live": "off" });
    this.choice = el("select", { "aria-label": "channel", hidden: true, onchange: () => plots.selectRow(this, Number(this.choice.value)) });
    this.part = el("select", { "aria-label": "part", hidden: true, onchange: () => plots.selectPart(this, Number(this.part.value)) });
    this.canvas = el("canvas", { role: "img", tabindex: "0" });
    const close = el("button", { class: "quiet", title: "Close this plot", "aria-label": "close", text: "✕", onclick: () => plots.close(this) });
    this.element = el(
      "article", { class: "panel" },
      el("div", { class: "head" }, this.heading, this.subtitle, this.readout, this.part, this.choice, close), this.canvas,
    );
    this.canvas.addEventListener("pointermove", (event) => this.#moveCursor(event, plots));
    this.canvas.addEventListener("pointerdown", (event) => this.#moveCursor(event, plots));
    this.canvas.addEventListener("pointerleave", () => { this.cursor = null; plots.setCursor(null); });
    this.canvas.addEventListener("keydown", (event) => this.#moveCursorByKey(event, plots));
  }

  #moveCursor(event, plots) {
    const box = this.canvas.getBoundingClientRect();
    this.cursor = { x: event.clientX - box.left, y: event.clientY - box.top };
    plots.setCursor(this.cursor.x);
  }

  #moveCursorByKey(event, plots) {
    const move = { ArrowLeft: [-4, 0], ArrowRight: [4, 0], ArrowUp: [0, -4], ArrowDown: [0, 4] }[event.key];
    if (!move) return;
    event.preventDefault();
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const at = this.cursor ?? { x: width / 2, y: height / 2 };
    this.cursor = { x: Math.max(0, Math.min(width, at.x + move[0])), y: Math.max(0, Math.min(height, at.y + move[1])) };
    plots.setCursor(this.cursor.x);
  }

  // Apply the description of the view.
  describe(view, kinds) {
    const replaced = !this.view || this.view.number !== view.number;
    this.view = view;
    this.problem = "";
    if (replaced) {
      this.series = new Series(view.ears * view.rows, view.rate);
      this.images = view.mode === "heat" ? Array.from({ length: view.ears }, () => columnImage(this.series.capacity, view.rows)) : [];
      this.range = null;
    }
    this.canvas.classList.toggle("tall", view.ears > 1 && view.mode !== "line");
    this.canvas.dataset.name = view.name;
    this.canvas.dataset.kind = view.kind;
    this.element.classList.toggle("wide", view.kind === "ratemap");
    this.heading.textContent = title(view.kind) + (kinds[view.kind]?.parts.length > 1 ? `: ${view.partName}` : "");
    this.subtitle.textContent = view.kind in SIDES ? `${view.name} · ${SIDES[view.kind]}` : view.name;
    this.subtitle.title = view.doc;
    this.canvas.setAttribute("aria-label", `${this.heading.textContent} of ${view.name} over time`);
    this.#updateChoices(view, kinds);
  }

  #updateChoices(view, kinds) {
    const parts = kinds[view.kind]?.parts ?? [];
    this.part.hidden = parts.length < 2;
    this.part.replaceChildren(...parts.map((part, index) => el("option", { value: String(index), text: part.name, selected: index === view.part })));
    this.choice.hidden = !view.choices.length;
    const options = view.choices.map((choice, index) =>
      el("option", { value: String(index), text: typeof choice === "string" ? choice : hertz(choice), selected: index === view.row }));
    if (view.mode === "heat") options.unshift(el("option", { value: "-1", text: "mean over channels", selected: view.row < 0 }));
    if (view.choices.length) this.choice.replaceChildren(...options);
  }

  append(piece) {
    const { from, to, restarted } = this.series.append(piece);
    if (restarted) for (const image of this.images) image.clear();
    if (this.range && this.view.mode === "heat") this.#paint(from, to);
  }

  // --- colours ---

  #colourMap(theme) {
    if (this.view.mode !== "heat") return "";
    if (this.#twoSided()) return theme.dark ? "divergingDark" : "divergingLight";
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
      this.series.forEach(from, to, (column, index) => {
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

  // Set the range to round limits of the visible values. It widens immediately and narrows after some seconds.
  updateRange(head, span, theme, now) {
    const { view, series } = this;
    if (!view || !series.next) return;
    const seen = [];
    const from = series.columnAt(head - span);
    const to = series.columnAt(head) + 1;
    const step = Math.max(1, Math.floor(((to - from) * series.size) / 6000));
    let count = 0;
    series.forEach(from, to, (column) => {
      for (const value of column) if (Number.isFinite(value) && (count += 1) % step === 0) seen.push(value);
    });
    if (!seen.length) return;
    seen.sort((a, b) => a - b);
    const quantile = (share) => seen[Math.min(seen.length - 1, Math.floor(share * seen.length))];
    let low = quantile(0.01);
    let high = quantile(0.995);
    if (view.mode === "wave") {
      high = roundUp(Math.max(Math.abs(seen[0]), Math.abs(seen.at(-1)), 1e-6));
      low = -high;
    } else if (view.level) {
      high = Math.ceil(quantile(0.998) / 5) * 5;
      low = high - RANGE_DB;
    } else if (this.#twoSided()) {
      high = roundUp(Math.max(Math.abs(quantile(0.02)), Math.abs(quantile(0.98)), view.unit === "dB" ? 5 : 1e-5));
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
    const map = this.#colourMap(theme);
    const old = this.range;
    const exceeded = !old || high > old.high || low < old.low;
    if (exceeded) this.rangeSetAt = now;
    if (map !== this.map || exceeded || (now - this.rangeSetAt > 4 && (high !== old.high || low !== old.low))) {
      this.map = map;
      this.range = { low, high };
      this.rangeSetAt = now;
      if (view.mode === "heat") this.#paint(series.first, series.next);
    }
  }

  // --- drawing ---

  draw(head, span, theme, cursorX) {
    const { canvas } = this;
    const context = prepare(canvas, theme);
    if (!context) return;
    const { clientWidth: width, clientHeight: height } = canvas;
    const ratio = canvas.width / width;
    const fontSize = theme.fontSize;
    this.fontSize = fontSize;
    const { view } = this;
    const bottom = BOTTOM * fontSize;
    const plots = view && view.mode !== "line" ? view.ears : 1;
    const plotHeight = (height - TOP - bottom - GAP * (plots - 1)) / plots;
    const boxes = Array.from({ length: plots }, (_, ear) => ({ x: LEFT * fontSize, y: TOP + ear * (plotHeight + GAP), w: width - (LEFT + RIGHT) * fontSize, h: plotHeight }));
    this.boxes = boxes;
    for (const box of boxes) {
      context.fillStyle = BACKGROUNDS[this.map] ?? theme.plot;
      context.fillRect(box.x, box.y, box.w, box.h);
    }
    if (!view || head === null || !this.range) {
      message(context, boxes[0], theme, this.problem || (view ? "waiting for audio" : "waiting"));
      return;
    }
    this.head = head;
    this.span = span;
    boxes.forEach((box, ear) => {
      context.save();
      context.beginPath();
      context.rect(box.x, box.y, box.w, box.h);
      context.clip();
      if (view.mode === "heat") drawColumns(context, box, this.images[ear], this.series, head, span);
      else if (view.mode === "wave") this.#wave(context, box, ear, head, span, theme);
      else this.#lines(context, box, head, span, theme);
      context.restore();
      this.#valueAxis(context, box, theme);
      if (plots > 1) this.#earLabel(context, box, EARS[ear]);
    });
    timeAxis(context, boxes.at(-1), span, theme);
    if (view.mode === "heat") this.#colourBar(context, boxes, theme);
    this.#drawCursor(context, boxes, theme, cursorX);
    if (this.problem) message(context, boxes[0], theme, this.problem);
    else if (canvas.title) canvas.title = "";
    const [box] = boxes;
    canvas.dataset.plot = JSON.stringify({
      x: box.x * ratio, y: box.y * ratio, w: box.w * ratio, h: box.h * ratio, from: head - span, to: head,
      ...this.range, first: view.along[0], last: view.along.at(-1),
    });
  }

  #earLabel(context, box, text) {
    context.textAlign = "left";
    context.textBaseline = "top";
    const width = context.measureText(text).width;
    context.fillStyle = "rgba(8, 10, 14, 0.6)";
    context.fillRect(box.x + 6, box.y + 5, width + 10, this.fontSize + 6);
    context.fillStyle = "#e8ebef";
    context.fillText(text, box.x + 11, box.y + 8);
  }

  #height(value, box) {
    const { along } = this.view;
    const half = along.length > 1 ? (along[1] - along[0]) / 2 : 0.5;
    const low = along[0] - half;
    return box.y + box.h * (1 - (value - low) / (along.at(-1) + half - low));
  }

  #level(value, box) {
    const { low, high } = this.range;
    return box.y + box.h * (1 - (value - low) / (high - low));
  }

  #wave(context, box, ear, head, span, theme) {
    const { series } = this;
    const perColumn = box.w / (span * series.rate);
    const left = series.columnAt(head - span);
    context.fillStyle = ear ? theme.right : theme.left;
    series.forEach(left - 1, left + span * series.rate + 1, (column, index) => {
      const low = column[ear * 2];
      const high = column[ear * 2 + 1];
      if (Number.isNaN(low)) return;
      const top = this.#level(high, box);
      context.fillRect(box.x + (index - left) * perColumn, top, Math.max(1, perColumn), Math.max(1, this.#level(low, box) - top));
    });
  }

  #lines(context, box, head, span, theme) {
    const { series, view } = this;
    const perColumn = box.w / (span * series.rate);
    const left = series.columnAt(head - span);
    for (let ear = 0; ear < view.ears; ear += 1) {
      context.strokeStyle = context.fillStyle = ear ? theme.right : theme.left;
      context.lineWidth = 1.8;
      context.lineJoin = "round";
      context.beginPath();
      let before = false;
      series.forEach(left - 1, left + span * series.rate + 1, (column, index) => {
        const value = column[ear];
        const x = box.x + (index + 0.5 - left) * perColumn;
        const y = this.#level(value, box);
        if (Number.isFinite(value)) {
          if (before) context.lineTo(x, y);
          else {
            context.moveTo(x, y);
            context.fillRect(x - 1.5, y - 1.5, 3, 3);
          }
        }
        before = Number.isFinite(value);
      });
      context.stroke();
    }
    if (view.ears > 1) {
      context.textBaseline = "top";
      context.textAlign = "left";
      EARS.forEach((name, ear) => {
        context.fillStyle = ear ? theme.right : theme.left;
        context.fillText(name, box.x + 8 + ear * 6 * this.fontSize, box.y + 6);
      });
    }
  }

  // --- axes ---

  #valueAxis(context, box, theme) {
    const { view } = this;
    context.fillStyle = theme.muted;
    context.strokeStyle = theme.grid;
    context.lineWidth = 1;
    context.textAlign = "right";
    context.textBaseline = "middle";
    let last = Infinity;
    const label = (y, text) => {
      if (y < box.y - 1 || y > box.y + box.h + 1 || Math.abs(last - y) < 15) return;
      last = y;
      context.fillText(text, box.x - 7, Math.max(box.y + 5, Math.min(box.y + box.h - 5, y)));
      context.beginPath();
      context.moveTo(box.x - 4, y);
      context.lineTo(box.x, y);
      context.stroke();
    };
    if (view.mode !== "heat") {
      for (const value of ticks(this.range.low, this.range.high, box.h / 28)) {
        const y = this.#level(value, box);
        label(y, tick(value));
        context.beginPath();
        context.moveTo(box.x, y);
        context.lineTo(box.x + box.w, y);
        context.stroke();
      }
      if (view.unit) this.#unit(context, box, view.unit);
    } else if (view.axis === "lag") {
      for (const lag of ticks(view.along[0] * 1e3, view.along.at(-1) * 1e3, box.h / 28)) label(this.#height(lag / 1e3, box), tick(lag));
      this.#unit(context, box, "ms");
    } else if (typeof view.along[0] === "number" && ["channel", "filter"].includes(view.axis)) {
      const frequencies = view.axis === "channel" ? FREQUENCIES : [...view.along];
      for (const frequency of frequencies) {
        const row = rowOf(view.along, frequency);
        if (row !== null) label(box.y + box.h * (1 - (row + 0.5) / view.rows), frequency >= 1000 ? `${Number((frequency / 1000).toPrecision(2))}k` : tick(frequency));
      }
      this.#unit(context, box, "Hz");
    } else {
      const step = Math.max(1, Math.ceil(view.rows / (box.h / 18)));
      for (let row = 0; row < view.rows; row += step) label(box.y + box.h * (1 - (row + 0.5) / view.rows), typeof view.along[row] === "number" ? view.along[row].toFixed(0) : String(view.along[row]).slice(0, 8));
    }
  }

  #unit(context, box, text) {
    context.save();
    context.translate(0.8 * this.fontSize, box.y + box.h / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.fillText(text, 0, 0);
    context.restore();
  }

  #colourBar(context, boxes, theme) {
    const x = boxes[0].x + boxes[0].w + 10;
    const y = boxes[0].y;
    const h = boxes.at(-1).y + boxes.at(-1).h - y;
    const table = colours(this.map);
    for (let step = 0; step < h; step += 1) {
      const colour = table[Math.round(255 * (1 - step / h))];
      context.fillStyle = `rgb(${colour & 255}, ${(colour >> 8) & 255}, ${(colour >> 16) & 255})`;
      context.fillRect(x, y + step, 9, 1.5);
    }
    context.fillStyle = theme.muted;
    context.textAlign = "left";
    context.textBaseline = "middle";
    const { low, high } = this.range;
    const scale = this.view.unit === "s" ? 1e3 : 1;
    for (const value of ticks(low * scale, high * scale, Math.min(6, h / 34))) {
      const at = y + h * (1 - (value / scale - low) / (high - low));
      context.fillText(tick(value), x + 13, Math.max(y + 5, Math.min(y + h - 5, at)));
    }
    context.textAlign = "right";
    context.textBaseline = "top";
    const unit = this.view.unit === "s" ? "ms" : this.view.unit;
    if (unit) context.fillText(unit, x + RIGHT * this.fontSize - 12, boxes.at(-1).y + boxes.at(-1).h + 5);
  }

  // --- the cursor ---

  #drawCursor(context, boxes, theme, cursorX) {
    const { x, w } = boxes[0];
    this.readout.textContent = "";
    if (cursorX === null || cursorX < x || cursorX > x + w) return;
    context.strokeStyle = theme.cursor;
    context.lineWidth = 1;
    const bottom = boxes.at(-1).y + boxes.at(-1).h;
    context.beginPath();
    context.moveTo(Math.round(cursorX) + 0.5, boxes[0].y);
    context.lineTo(Math.round(cursorX) + 0.5, bottom);
    if (this.cursor) {
      context.moveTo(x, Math.round(this.cursor.y) + 0.5);
      context.lineTo(x + w, Math.round(this.cursor.y) + 0.5);
    }
    context.stroke();
    this.readout.textContent = this.readAt(cursorX);
  }

  // The time and the values at the cursor.
  readAt(x) {
    const { boxes, view, series, head, span, cursor } = this;
    const ago = (span * (boxes[0].x + boxes[0].w - x)) / boxes[0].w;
    const time = head - ago;
    const column = series.at(time);
    const texts = [`${time.toFixed(2)} s`];
    if (!column) return [...texts, "none"].join(" · ");
    if (view.mode === "line") texts.push(...Array.from(column, (value, ear) => (view.ears > 1 ? `${"LR"[ear]} ` : "") + quantity(value, view.unit)));
    else if (view.mode === "wave") texts.push(...[0, 1].slice(0, view.ears).map((ear) => `${"LR"[ear]} ${number(Math.max(Math.abs(column[2 * ear]), Math.abs(column[2 * ear + 1])))}`));
    else if (cursor) {
      const ear = boxes.findIndex((box) => cursor.y >= box.y && cursor.y <= box.y + box.h);
      if (ear < 0) return texts[0];
      const row = Math.min(view.rows - 1, Math.floor((1 - (cursor.y - boxes[ear].y) / boxes[ear].h) * view.rows));
      const along = view.along[Math.max(0, row)];
      texts.push(view.axis === "lag" ? quantity(along, "s") : typeof along === "number" && view.axis !== "feature" ? hertz(along) : String(along));
      texts.push(quantity(column[ear * view.rows + row], view.unit));
    }
    return texts.join(" · ");
  }
}

// The fractional row of a frequency among the increasing frequencies of the rows, or null.
function rowOf(along, frequency) {
  if (along.length < 2) return along[0] === frequency ? 0 : null;
  const at = along.findIndex((one) => one >= frequency);
  if (at < 0) return frequency <= along.at(-1) * 1.04 ? along.length - 1 : null;
  if (at === 0) return frequency >= along[0] * 0.96 ? 0 : null;
  return at - 1 + Math.log(frequency / along[at - 1]) / Math.log(along[at] / along[at - 1]);
}
