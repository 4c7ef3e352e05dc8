// The circle of the directions while the true azimuth is in front: the azimuths of the page, and the mean positions of
// the pixels with the colours of source 7 and of the truth near the rim, in units of the radius, right and downwards.
const canvas = document.querySelector('canvas[data-kind=directions]');
if (!canvas?.dataset.plot) return null;
const { circle: { x, y, r }, present, truth } = JSON.parse(canvas.dataset.plot);
if (present.length !== 1 || truth.length !== 1 || Math.abs(truth[0]) > 60) return null;
const size = Math.round(2.2 * r);
const [x0, y0] = [Math.round(x - size / 2), Math.round(y - size / 2)];
const { data } = canvas.getContext("2d").getImageData(x0, y0, size, size);
const centre = (colour) => {
  let [sx, sy, count] = [0, 0, 0];
  for (let at = 0; at < size * size; at += 1) {
    const [dx, dy] = [(at % size) + 0.5 + x0 - x, Math.floor(at / size) + 0.5 + y0 - y];
    const distance = Math.hypot(dx, dy) / r;
    const far = [0, 1, 2].reduce((sum, one) => sum + Math.abs(data[4 * at + one] - colour[one]), 0);
    if (distance > 0.78 && distance < 0.97 && far < 30) { sx += dx; sy += dy; count += 1; }
  }
  return count > 10 ? [sx / count / r, sy / count / r] : null;
};
const result = { present, truth, sourcePlace: centre([255, 180, 84]), truthPlace: centre([255, 255, 255]) };
return result.sourcePlace && result.truthPlace ? result : null;
