// For each column of a plot: the row of the pixel nearest to a colour, and its distance; and the position of the plot.
const canvas = document.querySelector(`canvas[data-kind="${arguments[0]}"]`);
if (!canvas?.dataset.plot) return null;
const plot = JSON.parse(canvas.dataset.plot);
const [x0, y0, w, h] = [plot.x, plot.y, plot.w, plot.h].map(Math.round);
const { data } = canvas.getContext("2d").getImageData(x0, y0, w, h);
const colour = arguments[1];
const rows = [], far = [];
for (let x = 0; x < w; x += 1) {
  let best = Infinity, row = -1, count = 0;
  for (let y = 0; y < h; y += 1) {
    const at = 4 * (y * w + x);
    const d = Math.abs(data[at] - colour[0]) + Math.abs(data[at + 1] - colour[1]) + Math.abs(data[at + 2] - colour[2]);
    if (d < best) { best = d; row = y; count = 1; } else if (d === best) { row += y; count += 1; }
  }
  rows.push(row / count); far.push(best);
}
return { plot, rows, far };
