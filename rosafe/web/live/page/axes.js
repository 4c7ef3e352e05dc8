// Parts of a plot that all panels draw in the same way, and directions as texts.

import { ticks } from "./colours.js";
import { tick } from "./ui.js";

// The time axis below a box; now is at its right edge.
export function timeAxis(context, box, span, theme) {
  context.fillStyle = theme.muted;
  context.strokeStyle = theme.grid;
  context.textBaseline = "top";
  const maxTicks = Math.max(2, Math.min(10, box.w / 70));
  for (const ago of ticks(0, span, maxTicks)) {
    const x = box.x + box.w * (1 - ago / span);
    context.textAlign = ago === 0 ? "right" : x < box.x + 16 ? "left" : "center";
    context.fillText(ago === 0 ? "0 s" : `−${tick(ago)} s`, x, box.y + box.h + 5);
    context.beginPath();
    context.moveTo(x, box.y + box.h);
    context.lineTo(x, box.y + box.h + 4);
    context.stroke();
  }
}

// A text in the middle of a box.
export function message(context, box, theme, text) {
  if (context.canvas.title !== text) context.canvas.title = text;
  context.font = `${1.2 * theme.fontSize}px ${theme.font}`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  const width = context.measureText(text).width + 24;
  context.fillStyle = theme.surface;
  context.globalAlpha = 0.85;
  context.fillRect(box.x + box.w / 2 - width / 2, box.y + box.h / 2 - 14, width, 28);
  context.globalAlpha = 1;
  context.fillStyle = theme.muted;
  context.fillText(text, box.x + box.w / 2, box.y + box.h / 2);
  context.font = `${theme.fontSize}px ${theme.font}`;
}

// Fit the canvas to its element, clear it, and return its context with CSS pixels as units; null if it is hidden.
export function prepare(canvas, theme) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (!width) return null;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = `${theme.fontSize}px ${theme.font}`;
  return context;
}

// A canvas that holds a ring of columns.
export function columnImage(width, rows) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = rows;
  const context = canvas.getContext("2d");
  const data = context.createImageData(1, rows);
  return {
    canvas, rows, pixels: new Uint32Array(data.data.buffer),
    put: (column) => context.putImageData(data, column, 0),
    clear: () => context.clearRect(0, 0, width, rows),
  };
}

// Draw the columns of an image that are visible in a box.
export function drawColumns(context, box, image, series, head, span) {
  const perColumn = box.w / (span * series.rate);
  const left = series.columnAt(head - span);
  const first = Math.max(series.first, Math.floor(left));
  const last = Math.min(series.next, Math.ceil(series.columnAt(head)) + 1);
  context.imageSmoothingEnabled = false;
  for (let from = first; from < last; ) {
    const place = from % series.capacity;
    const count = Math.min(last - from, series.capacity - place);
    context.drawImage(image.canvas, place, 0, count, image.rows, box.x + (from - left) * perColumn, box.y, count * perColumn, box.h);
    from += count;
  }
}

// An azimuth (degrees, left is positive) as a text.
export function azimuthText(azimuth) {
  const whole = Math.round(azimuth);
  if (whole === 0) return "ahead";
  return Math.abs(whole) === 180 ? "behind" : `${Math.abs(whole)}° ${whole > 0 ? "left" : "right"}`;
}
