// The live page: brings its parts together.

import { Health } from "./health.js";
import { Link } from "./link.js";
import { direction } from "./panel.js";
import { Pictures } from "./pictures.js";
import { Meters, Source } from "./source.js";
import { TreeView } from "./tree.js";
import { el, store, stored, tried } from "./ui.js";

const SPANS = [5, 10, 30];
const SILENT = 1.2; // seconds without sound that are worth a word

// The token is to stay in no history and on no screen. It is kept for reloads, for this window and this server only.
let token = new URLSearchParams(location.search).get("token");
try {
  if (token) sessionStorage.setItem("rosafe.token", token);
  else token = sessionStorage.getItem("rosafe.token");
} catch {
  // a browser that keeps nothing forgets it
}
if (location.search) history.replaceState(null, "", location.pathname);

const at = (id) => document.getElementById(id);
const link = new Link(token ?? "");
const pictures = new Pictures(link, at("pictures"));
const meters = new Meters(at("meters"));
const health = new Health(at("health"));
let source = null;
let tree = null;
let processors = [];
let status = null;
let watch = false;

pictures.meter = (piece) => meters.take(piece);

// --- dark and light ---

function dress(theme) {
  document.documentElement.dataset.theme = theme;
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  pictures.theme = {
    dark: theme === "dark", font: getComputedStyle(document.body).fontFamily,
    cursor: theme === "dark" ? "rgba(255, 255, 255, 0.65)" : "rgba(20, 24, 30, 0.65)", track: "#ffb454",
    letter: Math.round(0.82 * parseFloat(getComputedStyle(document.body).fontSize)),
    ...Object.fromEntries(["text", "muted", "surface", "plot", "grid", "left", "right", "accent"].map((name) => [name, colour(name)])),
  };
  at("theme").textContent = theme === "dark" ? "☾" : "☀";
}

const wishes = matchMedia("(prefers-color-scheme: light)");
dress(stored("theme", wishes.matches ? "light" : "dark"));
addEventListener("resize", () => dress(document.documentElement.dataset.theme));
at("theme").addEventListener("click", () => {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  store("theme", theme);
  dress(theme);
});

// --- the view ---

at("span").append(...SPANS.map((span) => el("button", {
  text: `${span} s`, "data-span": String(span), "aria-pressed": String(span === pictures.span),
  onclick: () => {
    pictures.span = span;
    store("span", span);
    for (const button of at("span").children) button.setAttribute("aria-pressed", String(Number(button.dataset.span) === span));
  },
})));

function freeze(on) {
  const frozen = pictures.freeze(on);
  at("freeze").setAttribute("aria-pressed", String(frozen));
  at("freeze").textContent = frozen ? "Frozen" : "Freeze";
}

at("freeze").addEventListener("click", () => freeze(pictures.frozen === null));
at("png").addEventListener("click", () => pictures.save());
document.addEventListener("keydown", (event) => {
  if (event.key === " " && ["BODY", "CANVAS"].includes(document.activeElement?.tagName)) {
    event.preventDefault();
    freeze(pictures.frozen === null);
  }
});

document.body.dataset.tab = "pictures";
for (const tab of document.querySelectorAll("[data-tab]:not(body)")) {
  tab.addEventListener("click", () => {
    document.body.dataset.tab = tab.dataset.tab;
    for (const other of document.querySelectorAll(".tabs button")) other.setAttribute("aria-pressed", String(other === tab));
  });
}

// --- what the server tells ---

link.addEventListener("hello", ({ detail }) => {
  watch = detail.watch;
  pictures.kinds = detail.kinds;
  source = new Source(link, at("source"), watch);
  tree = new TreeView(link, at("tree"), at("processor"), pictures, detail, watch);
  if (!watch) source.look();
  pictures.reconnect();
});

link.addEventListener("tree", ({ detail }) => {
  processors = detail.processors;
  pictures.grow(processors, processors.length > 0 || (status && !status.problem));
  tree?.tree(processors);
  if (tree?.wanted && processors.some((one) => one.name === tree.wanted)) {
    const one = processors.find((each) => each.name === tree.wanted);
    tree.wanted = null;
    if (!pictures.isOpen(one.name)) pictures.toggle(one);
  }
  invite();
});

let counted = { bytes: 0, at: performance.now() };
link.addEventListener("status", ({ detail }) => {
  const now = performance.now();
  if (now - counted.at > 900) {
    link.rate = ((link.bytes - counted.bytes) / (now - counted.at)) * 1000;
    counted = { bytes: link.bytes, at: now };
  }
  status = detail;
  source?.status(detail);
  tree?.status(detail);
  health.status(detail, processors, link);
  if (detail.silent === null || detail.silent > SILENT) meters.rest();
  if (!detail.problem && !processors.length) pictures.grow([], true);
  for (const panel of pictures.panels) if (detail.problem) panel.problem = detail.problem;
  tell();
  invite();
});
link.rate = 0;

let closed = "";
link.addEventListener("open", () => { closed = ""; });
link.addEventListener("close", ({ detail }) => {
  status = null;
  if (detail.reason || !closed) closed = detail.reason;
  if (detail.failed) closed = `the server has closed the connection: ${closed || "no reason given"}; reload the page`;
  tell();
});

function tell() {
  const [state, text] = told();
  at("state").dataset.state = state;
  at("state").textContent = text;
  at("state").title = text;
}

function told() {
  if (!status) return ["bad", closed || link.refusal || "no connection to the server"];
  if (status.problem) return ["bad", status.problem];
  const malformed = Object.entries(status.malformed);
  if (malformed.length) return ["bad", malformed.map(([topic, why]) => `${topic}: malformed messages are ignored: ${why}`).join("; ")];
  if (!status.bass && (status.silent === null || status.silent > SILENT)) return ["bad", "no sound: bass is not running"];
  if (status.silent === null || status.silent > SILENT) return ["warn", "no sound: nothing is acquired"];
  if (status.failures.length) return ["bad", status.failures[0]];
  const heard = pictures.heard();
  const where = heard ? direction(heard.view, heard.lag) : "";
  return ["live", `${watch ? "watching" : "live"}${where ? ` · source ${where}` : ""}`];
}

setInterval(() => { if (status && !status.problem) tell(); }, 250);

// What to do where there is nothing to see.
let invited = "";
function invite() {
  const silent = !status || status.silent === null || status.silent > SILENT;
  const words = JSON.stringify([status?.problem, silent, processors.length, watch]);
  if (words === invited) return;
  invited = words;
  const parts = [];
  if (status?.problem) parts.push(el("h2", { text: "rosAFE does not answer" }), el("p", { text: status.problem }), el("p", { text: "The page goes on by itself once it is there: rosAFE-ros starts it." }));
  else if (processors.length) parts.push(el("h2", { text: "No picture is open" }), el("p", { text: "The eye beside a processor opens one." }));
  else {
    parts.push(el("h2", { text: "There are no processors yet" }));
    if (watch) parts.push(el("p", { text: "This page only watches; it shows them once somebody has built some." }));
    else if (silent) parts.push(el("p", { text: "Start the sound first, under Sound." }));
    else {
      const go = el("button", { class: "primary", text: "Build cochleagram, level and time differences", onclick: async () => {
        go.disabled = true;
        await tried(link.ask("usual"));
        go.disabled = false;
      } });
      parts.push(el("p", { text: "One click builds what this page is for; Add… builds anything else." }), go);
    }
  }
  pictures.empty.replaceChildren(...parts);
}

invite();
link.open();
