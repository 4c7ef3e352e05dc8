// The live page: creates its parts and connects them to the messages of the server.

import { azimuthText } from "./axes.js";
import { Health } from "./health.js";
import { Link } from "./link.js";
import { Plots } from "./plots.js";
import { Meters, Source } from "./source.js";
import { TreeView } from "./tree.js";
import { el, loadSetting, reportErrors, saveSetting } from "./ui.js";

const SPANS = [5, 10, 30];
const SILENCE_SECONDS = 1.2; // without audio, until the page reports it

// The token is removed from the address bar and the history. It is kept for reloads, for this window and server only.
let token = new URLSearchParams(location.search).get("token");
try {
  if (token) sessionStorage.setItem("rosafe.token", token);
  else token = sessionStorage.getItem("rosafe.token");
} catch {
  // the browser does not allow session storage
}
if (location.search) history.replaceState(null, "", location.pathname);

const byId = (id) => document.getElementById(id);
const link = new Link(token ?? "");
const plots = new Plots(link, byId("plots"));
const meters = new Meters(byId("meters"));
const health = new Health(byId("health"));
let source = null;
let tree = null;
let processors = [];
let status = null;
let watch = false;

plots.onLevels = (piece) => meters.update(piece);

// --- theme ---

function applyTheme(theme) {
  document.documentElement.dataset.theme = theme;
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  plots.theme = {
    dark: theme === "dark", font: getComputedStyle(document.body).fontFamily,
    cursor: theme === "dark" ? "rgba(255, 255, 255, 0.65)" : "rgba(20, 24, 30, 0.65)", track: "#ffb454",
    fontSize: Math.round(0.82 * parseFloat(getComputedStyle(document.body).fontSize)),
    ...Object.fromEntries(["text", "muted", "surface", "plot", "grid", "left", "right", "accent"].map((name) => [name, colour(name)])),
  };
  byId("theme").textContent = theme === "dark" ? "☾" : "☀";
}

const prefersLight = matchMedia("(prefers-color-scheme: light)");
applyTheme(loadSetting("theme", prefersLight.matches ? "light" : "dark"));
addEventListener("resize", () => applyTheme(document.documentElement.dataset.theme));
byId("theme").addEventListener("click", () => {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  saveSetting("theme", theme);
  applyTheme(theme);
});

// --- view controls ---

byId("span").append(...SPANS.map((span) => el("button", {
  text: `${span} s`, "data-span": String(span), "aria-pressed": String(span === plots.span),
  onclick: () => {
    plots.span = span;
    saveSetting("span", span);
    for (const button of byId("span").children) button.setAttribute("aria-pressed", String(Number(button.dataset.span) === span));
  },
})));

function freeze(on) {
  const frozen = plots.freeze(on);
  byId("freeze").setAttribute("aria-pressed", String(frozen));
  byId("freeze").textContent = frozen ? "Frozen" : "Freeze";
}

byId("freeze").addEventListener("click", () => freeze(plots.frozen === null));
byId("directions").addEventListener("click", () => plots.toggleDirections());
plots.addEventListener("change", () => byId("directions").setAttribute("aria-pressed", String(plots.isOpen(""))));
byId("png").addEventListener("click", () => plots.save());
document.addEventListener("keydown", (event) => {
  if (event.key === " " && ["BODY", "CANVAS"].includes(document.activeElement?.tagName)) {
    event.preventDefault();
    freeze(plots.frozen === null);
  }
});

document.body.dataset.tab = "plots";
for (const tab of document.querySelectorAll("[data-tab]:not(body)")) {
  tab.addEventListener("click", () => {
    document.body.dataset.tab = tab.dataset.tab;
    for (const other of document.querySelectorAll(".tabs button")) other.setAttribute("aria-pressed", String(other === tab));
  });
}

// --- messages of the server ---

link.addEventListener("hello", ({ detail }) => {
  watch = detail.watch;
  plots.kinds = detail.kinds;
  source = new Source(link, byId("source"), watch);
  tree = new TreeView(link, byId("tree"), byId("processor"), plots, detail, watch);
  if (!watch) source.loadDevices();
  plots.resubscribe();
});

link.addEventListener("tree", ({ detail }) => {
  processors = detail.processors;
  plots.updateTree(processors, processors.length > 0 || (status && !status.problem));
  tree?.update(processors);
  showEmptyState();
});

let measured = { bytes: 0, at: performance.now() };
link.addEventListener("status", ({ detail }) => {
  const now = performance.now();
  if (now - measured.at > 900) {
    link.rate = ((link.bytes - measured.bytes) / (now - measured.at)) * 1000;
    measured = { bytes: link.bytes, at: now };
  }
  status = detail;
  source?.status(detail);
  tree?.status(detail);
  health.status(detail, processors, link);
  plots.setDirectionHint(detail.localizer === null ? "no localizer is running; start it with: rosafe localize" : `localizer: ${detail.localizer}`);
  if (detail.silent === null || detail.silent > SILENCE_SECONDS) meters.showSilence();
  if (!detail.problem && !processors.length) plots.updateTree([], true);
  for (const panel of plots.panels) if (detail.problem) panel.problem = detail.problem;
  announce();
  showEmptyState();
});
link.rate = 0;

let closeReason = "";
link.addEventListener("open", () => { closeReason = ""; });
link.addEventListener("close", ({ detail }) => {
  status = null;
  if (detail.reason || !closeReason) closeReason = detail.reason;
  if (detail.fatal) closeReason = `the server has closed the connection: ${closeReason || "no reason given"}; reload the page`;
  announce();
});

function announce() {
  const [state, text] = statusText();
  byId("state").dataset.state = state;
  byId("state").textContent = text;
  byId("state").title = text;
}

function statusText() {
  if (!status) return ["bad", closeReason || link.refusal || "no connection to the server"];
  if (status.problem) return ["bad", status.problem];
  const malformed = Object.entries(status.malformed);
  if (malformed.length) return ["bad", malformed.map(([topic, why]) => `${topic}: malformed messages are ignored: ${why}`).join("; ")];
  if (!status.bass && (status.silent === null || status.silent > SILENCE_SECONDS)) return ["bad", "no audio: bass is not running"];
  if (status.silent === null || status.silent > SILENCE_SECONDS) return ["warn", "no audio: the capture is stopped"];
  if (status.failures.length) return ["bad", status.failures[0]];
  const sources = plots.presentDirections().map(azimuthText);
  const where = sources.length ? ` · source${sources.length > 1 ? "s" : ""} ${sources.join(", ")}` : "";
  return ["live", `${watch ? "watching" : "live"}${where}`];
}

setInterval(() => { if (status && !status.problem) announce(); }, 250);

// Instructions that are shown while no plot is open.
let shownState = "";
function showEmptyState() {
  const silent = !status || status.silent === null || status.silent > SILENCE_SECONDS;
  const state = JSON.stringify([status?.problem, silent, processors.length, watch]);
  if (state === shownState) return;
  shownState = state;
  const parts = [];
  if (status?.problem) parts.push(el("h2", { text: "rosAFE does not answer" }), el("p", { text: status.problem }), el("p", { text: "This page continues when rosAFE answers. If it is not running, start rosAFE-ros." }));
  else if (processors.length) parts.push(el("h2", { text: "No plot is open" }), el("p", { text: "Click the eye next to a processor to open its plot." }));
  else {
    parts.push(el("h2", { text: "There are no processors yet" }));
    if (watch) parts.push(el("p", { text: "This page can only watch. It shows the processors that other clients build." }));
    else if (silent) parts.push(el("p", { text: "Start the capture first, under Audio." }));
    else {
      const button = el("button", { class: "primary", text: "Build cochleagram, level and time differences", onclick: async () => {
        button.disabled = true;
        await reportErrors(link.request("usual"));
        button.disabled = false;
      } });
      parts.push(el("p", { text: "This creates the default plots. Click Add… for other representations." }), button);
    }
  }
  plots.empty.replaceChildren(...parts);
}

showEmptyState();
link.open();
