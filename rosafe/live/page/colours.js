// Colours of numbers: maps whose lightness rises evenly, and one with two sides.

// Magma and viridis of matplotlib (CC0), at even distances; what lies between is interpolated.
const STOPS = {
  magma: ["#000004", "#140e36", "#3b0f70", "#641a80", "#8c2981", "#b73779", "#de4968", "#f7705c", "#fe9f6d", "#fecf92", "#fcfdbf"],
  viridis: ["#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725"],
  // dark at its top, for lines to stand out
  deep: ["#0a0c18", "#121c38", "#1b2f52", "#254a6b", "#336b88", "#4c8d9f", "#7ab3b3", "#b4d5cd"],
  darkSides: ["#9fd8ff", "#5aa9ff", "#2d6fc0", "#1d436f", "#10151c", "#6b3420", "#bb5630", "#ff8a5c", "#ffd2b8"],
  lightSides: ["#0b3d78", "#1f6fc4", "#71a8de", "#bcd7f0", "#f6f7f8", "#f3cdb8", "#e2935f", "#c4541f", "#7c2d08"],
};

function channels(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

const made = new Map();

// 256 colours as Uint32, as canvases take them.
export function colours(name) {
  if (!made.has(name)) {
    const stops = STOPS[name].map(channels);
    const table = new Uint32Array(256);
    for (let step = 0; step < 256; step += 1) {
      const place = (step / 255) * (stops.length - 1);
      const below = Math.min(stops.length - 2, Math.floor(place));
      const part = place - below;
      const [r, g, b] = [0, 1, 2].map((c) => Math.round(stops[below][c] * (1 - part) + stops[below + 1][c] * part));
      table[step] = (255 << 24) | (b << 16) | (g << 8) | r;
    }
    made.set(name, table);
  }
  return made.get(name);
}

// A round number that is not less.
export function roundUp(value) {
  if (!(value > 0)) return 1;
  const decade = 10 ** Math.floor(Math.log10(value));
  return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((step) => step * decade >= value * 0.9999) * decade;
}

export function ticks(low, high, most) {
  const wanted = (high - low) / Math.max(1, most);
  const decade = 10 ** Math.floor(Math.log10(wanted));
  const step = [1, 2, 2.5, 5, 10].find((one) => one * decade >= wanted * 0.9999) * decade;
  const found = [];
  for (let at = Math.ceil(low / step - 1e-9); at * step <= high + step * 1e-9; at += 1) found.push(at * step);
  return found;
}
