// Helpers for elements, messages, numbers with units, downloads and settings.

export function el(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && typeof value !== "string") element[name] = value;
    else if (name === "text") element.textContent = value;
    else if (name === "class") element.className = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

export function svg(path) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  element.setAttribute("viewBox", "0 0 24 24");
  element.setAttribute("aria-hidden", "true");
  const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
  line.setAttribute("d", path);
  element.append(line);
  return element;
}

export function toast(text, bad = false) {
  const note = el("p", { class: bad ? "toast bad" : "toast", text });
  document.getElementById("toasts").append(note);
  setTimeout(() => note.remove(), bad ? 9000 : 4000);
}

// Await a promise; show an error as a message and return null.
export async function reportErrors(promise, done = "") {
  try {
    const answer = await promise;
    if (done) toast(done);
    return answer;
  } catch (problem) {
    toast(problem.message, true);
    return null;
  }
}

export function hertz(value) {
  if (value >= 10000) return `${(value / 1000).toFixed(1)} kHz`;
  if (value >= 1000) return `${(value / 1000).toFixed(2)} kHz`;
  return `${value.toFixed(value < 10 ? 1 : 0)} Hz`;
}

export function seconds(value) {
  const size = Math.abs(value);
  if (size >= 1) return `${value.toFixed(2)} s`;
  if (size >= 1e-3 || size === 0) return `${(value * 1e3).toFixed(size < 0.01 ? 2 : 0)} ms`;
  return `${(value * 1e6).toFixed(0)} µs`;
}

export function number(value) {
  if (!Number.isFinite(value)) return "none";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(2).replace("-", "−");
  return value.toFixed(size < 1 ? 3 : size < 100 ? 1 : 0).replace("-", "−");
}

// A number on an axis, without trailing zeros.
export function tick(value) {
  const text = number(value);
  return text.includes(".") && !text.includes("e") ? text.replace(/\.?0+$/, "") : text;
}

// A value with its unit; times below 1 s are given in ms or µs.
export function quantity(value, unit) {
  if (!Number.isFinite(value)) return "none";
  if (unit === "s") return seconds(value).replace("-", "−");
  return unit ? `${number(value)} ${unit}` : number(value);
}

// Save a file on the user's computer.
export function download(blob, name) {
  const link = el("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

export function loadSetting(name, fallback) {
  try {
    return JSON.parse(localStorage.getItem(`rosafe.${name}`)) ?? fallback;
  } catch {
    return fallback;
  }
}

export function saveSetting(name, value) {
  try {
    localStorage.setItem(`rosafe.${name}`, JSON.stringify(value));
  } catch {
    // the browser does not allow local storage
  }
}
