// Colour maps: sequential ones with evenly increasing lightness, and diverging ones. Round numbers for axes.

// Equidistant colours of matplotlib's magma and viridis (CC0); the colours between them are interpolated.
const STOPS = {
  magma: ["#000004", "#140e36", "#3b0f70", "#641a80", "#8c2981", "#b73779", "#de4968", "#f7705c", "#fe9f6d", "#fecf92", "#fcfdbf"],
  viridis: ["#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725"],
  // dark at low values, so that lines are visible
  deep: ["#0a0c18", "#121c38", "#1b2f52", "#254a6b", "#336b88", "#4c8d9f", "#7ab3b3", "#b4d5cd"],
  divergingDark: ["#9fd8ff", "#5aa9ff", "#2d6fc0", "#1d436f", "#10151c", "#6b3420", "#bb5630", "#ff8a5c", "#ffd2b8"],
  divergingLight: ["#0b3d78", "#1f6fc4", "#71a8de", "#bcd7f0", "#f6f7f8", "#f3cdb8", "#e2935f", "#c4541f", "#7c2d08"],
};

function rgb(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

const tables = new Map();

// A table of 256 colours as Uint32, in the pixel format of a canvas.
export function colours(name) {
  if (!tables.has(name)) {
    const stops = STOPS[name].map(rgb);
    const table = new Uint32Array(256);
    for (let step = 0; step < 256; step += 1) {
      const position = (step / 255) * (stops.length - 1);
      const below = Math.min(stops.length - 2, Math.floor(position));
      const fraction = position - below;
      const [r, g, b] = [0, 1, 2].map((c) => Math.round(stops[below][c] * (1 - fraction) + stops[below + 1][c] * fraction));
      table[step] = (255 << 24) | (b << 16) | (g << 8) | r;
    }
    tables.set(name, table);
  }
  return tables.get(name);
}

// The next larger round number.
export function roundUp(value) {
  if (!(value > 0)) return 1;
  const decade = 10 ** Math.floor(Math.log10(value));
  return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((step) => step * decade >= value * 0.9999) * decade;
}

// Round values between two limits, at most about `count`.
export function ticks(low, high, count) {
  const spacing = (high - low) / Math.max(1, count);
  const decade = 10 ** Math.floor(Math.log10(spacing));
  const step = [1, 2, 2.5, 5, 10].find((factor) => factor * decade >= spacing * 0.9999) * decade;
  const values = [];
  for (let at = Math.ceil(low / step - 1e-9); at * step <= high + step * 1e-9; at += 1) values.push(at * step);
  return values;
}
