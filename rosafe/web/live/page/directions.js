// The panel of the localizer: posterior and sources around the head, and their azimuths over time. Left is positive, and
// at the left of the circle; 0 degrees are at its top.

import { azimuthText, columnImage, drawColumns, message, prepare, timeAxis } from "./axes.js";
import { colours } from "./colours.js";
import { Series } from "./series.js";
import { el } from "./ui.js";

const BACKGROUND = "#0a0c18"; // similar to the darkest colour of the map "deep"
const COLOURS = ["#ffb454", "#7ee787", "#79c0ff", "#ff7b9c", "#d2a8ff", "#f2e05c"]; // of the sources, by their numbers
const TRUTH = "#ffffff";
const PRESENT = 0.5; // probability of a source that is present
const SPEAKS = 0.5; // probability of a source that speaks
const SOURCE_NUMBERS = 5; // number, azimuth, standard deviation, probabilities that it exists and that it speaks
const STALE_SECONDS = 1; // without a column until the circle is empty
const LOW = -177.5; // degrees at the lower edge of the plot over time
const MARKS = [180, 90, 0, -90]; // degrees

export class DirectionPanel {
  constructor(plots) {
    this.key = { what: "directions", name: "" };
    this.kind = "directions";
    this.view = null;
    this.series = null;
    this.range = null;
    this.problem = "";
    this.hint = ""; // how to start the localizer, or the reason why it waits
    this.cursor = null; // { x, y } in CSS pixels
    this.heading = el("h2", { text: "Directions" });
    this.readout = el("span", { class: "read", "aria-live": "off" });
    this.canvas = el("canvas", { class: "directions idle", role: "img", tabindex: "0", "aria-label": "directions of sources around the head, and over time" });
    this.canvas.dataset.kind = "directions";
    const close = el("button", { class: "quiet", title: "Close this plot", "aria-label": "close", text: "✕", onclick: () => plots.close(this) });
    this.element = el(
      "article", { class: "panel" },
      el("div", { class: "head" }, this.heading, el("span", { class: "subtitle", text: "localizer · filled: speaks · white: truth of a scene" }), this.readout, close), this.canvas,
    );
    const point = (event) => {
      const box = this.canvas.getBoundingClientRect();
      this.cursor = { x: event.clientX - box.left, y: event.clientY - box.top };
    };
    this.canvas.addEventListener("pointermove", point);
    this.canvas.addEventListener("pointerdown", point);
    this.canvas.addEventListener("pointerleave", () => { this.cursor = null; });
  }

  describe(view) {
    if (!this.view || this.view.number !== view.number) {
      this.series = new Series(view.rows, view.rate);
      this.image = columnImage(this.series.capacity, view.azimuths.length);
    }
    this.view = view;
    this.problem = "";
  }

  append(piece) {
    const { from, to, restarted } = this.series.append(piece);
    if (restarted) this.image.clear();
    const table = colours("deep");
    const { pixels, rows } = this.image;
    this.series.forEach(from, to, (column, index) => {
      for (let row = 0; row < rows; row += 1) {
        const value = column[row];
        pixels[rows - 1 - row] = Number.isNaN(value) ? 0 : table[Math.round(255 * Math.sqrt(Math.min(1, value)))];
      }
      this.image.put(index % this.series.capacity);
    });
  }

  updateRange() {}

  // The sources of a column, and the true azimuths, in degrees.
  #sources(column) {
    const { azimuths, slots } = this.view;
    const sources = [];
    for (let slot = 0; slot < slots; slot += 1) {
      const [id, azimuth, std, probability, speech] = column.subarray(azimuths.length + slot * SOURCE_NUMBERS, azimuths.length + (slot + 1) * SOURCE_NUMBERS);
      if (Number.isFinite(azimuth)) sources.push({ id, azimuth, std, probability, speaks: speech > SPEAKS });
    }
    return sources;
  }

  #truths(column) {
    const { azimuths, slots } = this.view;
    return [...column.subarray(azimuths.length + slots * SOURCE_NUMBERS)].filter(Number.isFinite);
  }

  // The newest column before the right edge, or null if it is old.
  newest(head) {
    if (!this.series?.next || head === null || head === undefined) return null;
    const time = Math.min(head, this.series.end - 0.5 / this.series.rate);
    return head - time < STALE_SECONDS ? this.series.at(time) : null;
  }

  // The azimuths of the sources that are present.
  present(head) {
    const column = this.newest(head);
    return column ? this.#sources(column).filter((one) => one.probability > PRESENT).map((one) => one.azimuth) : [];
  }

  // --- drawing ---

  draw(head, span, theme) {
    const { canvas } = this;
    const idle = !this.series?.next;
    canvas.classList.toggle("idle", idle);
    const context = prepare(canvas, theme);
    if (!context) return;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (idle || head === null) {
      this.readout.textContent = "";
      message(context, { x: 0, y: 0, w: width, h: height }, theme, this.problem || this.hint || "waiting for the localizer");
      return;
    }
    const font = theme.fontSize;
    const stacked = width < 1.7 * height;
    const radius = (stacked ? Math.min(width / 2, height / 4) : height / 2) - 1.6 * font;
    const circle = { x: stacked ? width / 2 : radius + 5.2 * font, y: radius + 1.6 * font, r: radius };
    const left = stacked ? 4.5 * font : 2 * circle.x + 5 * font;
    const top = stacked ? 2 * circle.y + font : 7;
    const box = { x: left, y: top, w: width - left - 1.2 * font, h: height - top - 1.75 * font };
    const newest = this.newest(head);
    this.#circle(context, circle, newest, theme);
    this.#overTime(context, box, head, span, theme);
    this.#read(box, circle, head, span, newest);
    if (this.problem || (!newest && this.hint)) message(context, box, theme, this.problem || this.hint);
    else canvas.title = "";
    const ratio = canvas.width / width;
    canvas.dataset.plot = JSON.stringify({
      x: box.x * ratio, y: box.y * ratio, w: box.w * ratio, h: box.h * ratio, from: head - span, to: head, low: LOW, high: LOW + 360,
      circle: { x: circle.x * ratio, y: circle.y * ratio, r: circle.r * ratio },
      present: this.present(head), truth: newest ? this.#truths(newest) : [],
    });
  }

  #circle(context, { x, y, r }, column, theme) {
    const at = (azimuth, radius) => {
      const angle = (azimuth * Math.PI) / 180;
      return [x - radius * Math.sin(angle), y - radius * Math.cos(angle)];
    };
    context.fillStyle = BACKGROUND;
    context.beginPath();
    context.arc(x, y, r, 0, 2 * Math.PI);
    context.fill();
    context.lineWidth = 1;
    context.strokeStyle = "rgba(255, 255, 255, 0.16)";
    for (let azimuth = 0; azimuth < 360; azimuth += 45) this.#line(context, at(azimuth, 0.12 * r), at(azimuth, r));
    for (const probability of [0.25, 1]) {
      context.beginPath();
      context.arc(x, y, r * Math.sqrt(probability), 0, 2 * Math.PI);
      context.stroke();
    }
    context.fillStyle = theme.muted;
    context.textAlign = "center";
    context.textBaseline = "bottom";
    context.fillText("ahead", x, y - r - 2);
    context.textBaseline = "top";
    context.fillText("behind", x, y + r + 3);
    context.textBaseline = "middle";
    context.textAlign = "right";
    context.fillText("90° left", x - r - 4, y);
    context.textAlign = "left";
    context.fillText("90° right", x + r + 4, y);
    if (!column) return;
    this.#posterior(context, column, at, r);
    for (const azimuth of this.#truths(column)) {
      context.strokeStyle = TRUTH;
      context.lineWidth = 2;
      context.beginPath();
      context.arc(...at(azimuth, 0.9 * r), 7, 0, 2 * Math.PI);
      context.stroke();
    }
    for (const { id, azimuth, std, probability, speaks } of this.#sources(column)) {
      context.globalAlpha = probability > PRESENT ? 1 : probability;
      context.strokeStyle = context.fillStyle = colourOf(id);
      context.lineWidth = 2;
      this.#line(context, at(azimuth, 0.12 * r), at(azimuth, 0.9 * r));
      context.beginPath();
      context.arc(...at(azimuth, 0.9 * r), 4, 0, 2 * Math.PI);
      if (!speaks) context.fillStyle = BACKGROUND;
      context.fill();
      context.stroke();
      context.lineWidth = 4;
      context.beginPath();
      const [first, last] = [azimuth + std, azimuth - std].map((a) => (-(a + 90) * Math.PI) / 180);
      context.arc(x, y, r, first, last);
      context.stroke();
      context.globalAlpha = 1;
    }
    context.fillStyle = "#e8ebef"; // the head, with its nose
    context.beginPath();
    context.arc(x, y, 0.07 * r, 0, 2 * Math.PI);
    context.moveTo(x - 0.03 * r, y - 0.06 * r);
    context.lineTo(x, y - 0.11 * r);
    context.lineTo(x + 0.03 * r, y - 0.06 * r);
    context.fill();
  }

  // The radius is the square root of the probability.
  #posterior(context, column, at, r) {
    const { azimuths } = this.view;
    if (!Number.isFinite(column[0])) return;
    const half = (azimuths[1] - azimuths[0]) / 2;
    context.fillStyle = "rgba(122, 179, 179, 0.75)";
    context.beginPath();
    azimuths.forEach((azimuth, index) => {
      const radius = r * Math.max(0.12, Math.sqrt(column[index]));
      for (const edge of [azimuth - half, azimuth + half]) context.lineTo(...at(edge, radius));
    });
    context.fill();
  }

  #line(context, from, to) {
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.stroke();
  }

  #height(azimuth, box) {
    return box.y + box.h * (1 - ((azimuth < LOW ? azimuth + 360 : azimuth) - LOW) / 360);
  }

  #overTime(context, box, head, span, theme) {
    const { series } = this;
    context.fillStyle = BACKGROUND;
    context.fillRect(box.x, box.y, box.w, box.h);
    context.save();
    context.beginPath();
    context.rect(box.x, box.y, box.w, box.h);
    context.clip();
    drawColumns(context, box, this.image, series, head, span);
    context.strokeStyle = "rgba(255, 255, 255, 0.16)";
    context.lineWidth = 1;
    for (const mark of MARKS) this.#line(context, [box.x, this.#height(mark, box)], [box.x + box.w, this.#height(mark, box)]);
    const perSecond = box.w / span;
    const width = perSecond / series.rate + 0.5;
    series.forEach(series.columnAt(head - span) - 1, series.columnAt(head) + 1, (column, index) => {
      const x = box.x + (series.zero + index / series.rate - head + span) * perSecond;
      context.fillStyle = TRUTH;
      for (const azimuth of this.#truths(column)) context.fillRect(x, this.#height(azimuth, box) - 1, width, 2);
      for (const { id, azimuth, probability, speaks } of this.#sources(column)) {
        if (probability <= PRESENT) continue;
        context.fillStyle = colourOf(id);
        context.fillRect(x, this.#height(azimuth, box) - 2, width, speaks ? 4 : 1);
        if (!speaks) context.fillRect(x, this.#height(azimuth, box) + 1, width, 1);
      }
    });
    context.restore();
    context.fillStyle = theme.muted;
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const mark of MARKS) context.fillText(azimuthText(mark), box.x - 5, Math.max(box.y + 5, this.#height(mark, box)));
    timeAxis(context, box, span, theme);
  }

  // The direction at the pointer, or the sources that are present.
  #read(box, circle, head, span, newest) {
    const texts = [];
    const { cursor } = this;
    if (cursor && cursor.x >= box.x && cursor.x <= box.x + box.w && cursor.y >= box.y && cursor.y <= box.y + box.h) {
      const time = head - (span * (box.x + box.w - cursor.x)) / box.w;
      const column = this.series.at(time);
      texts.push(`${time.toFixed(2)} s`, ...(column ? this.#sources(column).map(sourceText) : []));
    } else if (cursor && newest && Math.hypot(cursor.x - circle.x, cursor.y - circle.y) <= circle.r) {
      const azimuth = (Math.atan2(circle.x - cursor.x, circle.y - cursor.y) * 180) / Math.PI;
      const { azimuths } = this.view;
      const row = Math.round((azimuth - azimuths[0]) / (azimuths[1] - azimuths[0]) + azimuths.length) % azimuths.length;
      texts.push(azimuthText(azimuths[row]), Number.isFinite(newest[row]) ? `probability ${newest[row].toFixed(3)}` : "no evidence");
    } else if (newest) {
      texts.push(...this.#sources(newest).filter((one) => one.probability > PRESENT).map(sourceText));
    }
    this.readout.textContent = texts.join(" · ");
  }
}

function sourceText({ id, azimuth, std, probability, speaks }) {
  return `source ${id}: ${azimuthText(azimuth)} ± ${Math.round(std)}° (${probability.toFixed(2)})${speaks ? ", speaks" : ""}`;
}

function colourOf(id) {
  return COLOURS[(id - 1 + COLOURS.length) % COLOURS.length];
}
