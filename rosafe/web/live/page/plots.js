// The open panels, the views that the page subscribes to, and the drawing loop.

import { DirectionPanel } from "./directions.js";
import { Panel, title } from "./panel.js";
import { Clock } from "./series.js";
import { download, el, loadSetting, saveSetting } from "./ui.js";

const DEFAULT_KINDS = ["ratemap", "ild", "crossCorrelation"]; // opened automatically, as are the directions
const ORDER = ["ratemap", "directions", "ild", "crossCorrelation"];
const MAX_VIEWS = 16; // limit of the server for a page
const RANGE_SECONDS = 0.5; // between two updates of the range of the values

const same = (a, b) => a.what === b.what && a.name === b.name && (a.what !== "picture" || (a.part === b.part && (a.row === b.row || a.row < 0)));

export class Plots extends EventTarget {
  constructor(link, element) {
    super();
    this.link = link;
    this.element = element;
    this.panels = [];
    this.clock = new Clock();
    this.kinds = {};
    this.tree = [];
    this.closed = new Set(loadSetting("closed", []));
    this.opened = loadSetting("opened", []);
    this.span = loadSetting("span", 10);
    this.frozen = null; // the head when the plots were frozen
    this.cursorX = null;
    this.views = new Map(); // by number: the function that receives the columns
    this.onLevels = () => {};
    this.empty = el("div", { class: "card empty" });
    this.visible = new IntersectionObserver((entries) => {
      for (const entry of entries) entry.target.unseen = !entry.isIntersecting;
    });
    link.addEventListener("open", () => this.#subscribe());
    link.addEventListener("views", (event) => this.#views(event.detail.views));
    link.addEventListener("columns", (event) => this.#receive(event.detail));
    link.addEventListener("close", () => this.panels.forEach((panel) => { panel.problem = "no connection"; }));
    requestAnimationFrame((now) => this.#draw(now));
  }

  // --- open panels ---

  // `complete` is false while the tree may be out of date.
  updateTree(processors, complete) {
    this.tree = processors;
    const names = new Set(processors.map((one) => one.name));
    if (processors.length) names.add(""); // the directions
    if (complete) {
      for (const panel of this.panels.filter((one) => !names.has(one.key.name))) this.#remove(panel);
      for (const kind of DEFAULT_KINDS) {
        const first = processors.find((one) => one.kind === kind && !this.closed.has(one.name));
        if (first && !this.panels.some((panel) => panel.kind === kind)) this.#add(first, 0, -1);
      }
      if (processors.length && !this.closed.has("") && !this.isOpen("")) this.#insert(new DirectionPanel(this));
      for (const { name, part, row } of this.opened) {
        const one = processors.find((each) => each.name === name);
        if (one && !this.isOpen(name)) this.#add(one, part, row);
      }
    }
    this.#update();
  }

  isOpen(name) {
    return this.panels.some((panel) => panel.key.name === name);
  }

  toggle(processor) {
    const open = this.panels.find((panel) => panel.key.name === processor.name);
    if (open) this.close(open);
    else {
      this.closed.delete(processor.name);
      this.#add(processor, 0, -1);
      this.#saveLayout();
      this.#update();
      this.panels.find((panel) => panel.key.name === processor.name)?.element.scrollIntoView({ block: "nearest" });
    }
  }

  toggleDirections() {
    const open = this.panels.find((panel) => panel.kind === "directions");
    if (open) this.close(open);
    else {
      this.closed.delete("");
      this.#saveLayout();
      this.updateTree(this.tree, true);
    }
  }

  close(panel) {
    this.closed.add(panel.key.name);
    this.#remove(panel);
    this.#saveLayout();
    this.#update();
  }

  selectRow(panel, row) {
    this.#change(panel, { row });
  }

  selectPart(panel, part) {
    this.#change(panel, { part, row: -1 });
  }

  #change(panel, change) {
    Object.assign(panel.key, change);
    panel.view = null;
    this.#saveLayout();
    this.#subscribe();
  }

  setCursor(x) {
    this.cursorX = x;
  }

  #add(processor, part, row) {
    const panel = new Panel({ what: "picture", name: processor.name, part, row }, this);
    panel.kind = processor.kind;
    panel.heading.textContent = title(processor.kind);
    this.#insert(panel);
  }

  #insert(panel) {
    const order = (kind) => (ORDER.includes(kind) ? ORDER.indexOf(kind) : ORDER.length);
    const before = this.panels.findIndex((one) => order(one.kind) > order(panel.kind));
    if (before < 0) this.panels.push(panel);
    else this.panels.splice(before, 0, panel);
    this.visible.observe(panel.canvas);
  }

  #remove(panel) {
    this.visible.unobserve(panel.canvas);
    this.panels = this.panels.filter((one) => one !== panel);
  }

  #saveLayout() {
    this.opened = this.panels.filter((panel) => panel.kind !== "directions" && (!DEFAULT_KINDS.includes(panel.kind) || panel.key.part || panel.key.row >= 0)).map((panel) => panel.key);
    saveSetting("opened", this.opened);
    saveSetting("closed", [...this.closed]);
  }

  #update() {
    const elements = this.panels.length ? this.panels.map((panel) => panel.element) : [this.empty];
    if (elements.length !== this.element.children.length || elements.some((one, index) => this.element.children[index] !== one)) this.element.replaceChildren(...elements);
    this.#subscribe();
    this.dispatchEvent(new Event("change"));
  }

  // --- subscriptions ---

  #keys() {
    const keys = [{ what: "levels" }];
    for (const panel of this.panels) {
      if (keys.length < MAX_VIEWS) keys.push({ ...panel.key });
      else panel.problem = "too many plots: close another one";
    }
    return keys;
  }

  #subscribed = "";

  #subscribe(resend = false) {
    const keys = this.#keys();
    const text = JSON.stringify(keys);
    if (resend || text !== this.#subscribed) {
      this.#subscribed = text;
      this.link.request("look", { keys, anew: resend }).catch(() => { this.#subscribed = ""; });
    }
  }

  resubscribe() {
    this.#subscribed = "";
    this.#subscribe();
  }

  #views(views) {
    this.views.clear();
    for (const view of views) {
      if (view.key.what === "levels") {
        if (view.number) this.views.set(view.number, (piece) => this.onLevels(piece));
        continue;
      }
      const { key } = view;
      const panel = this.panels.find((one) => same(one.key, key));
      if (!panel) continue;
      panel.problem = view.error ?? "";
      if (view.error !== undefined) continue;
      panel.describe(view, this.kinds);
      this.views.set(view.number, (piece, now) => {
        panel.append(piece);
        // Estimates are later than other columns. Therefore they do not set the clock if there are others.
        if (panel.kind !== "directions" || this.panels.length === 1) this.clock.observe(panel.series, now);
      });
    }
  }

  #receive(piece) {
    const append = this.views.get(piece.number);
    if (append && (this.frozen === null || append.length === 1)) append(piece, performance.now() / 1000);
  }

  // --- drawing ---

  freeze(on) {
    if (on) {
      this.frozen = this.clock.head(performance.now() / 1000);
      if (this.frozen === null) return false;
    } else {
      this.frozen = null;
      this.clock.reset();
      this.panels.forEach((panel) => { panel.series?.clear(); });
      this.#subscribe(true);
    }
    return this.frozen !== null;
  }

  // The azimuths (degrees) of the sources that are present.
  presentDirections() {
    return this.panels.find((one) => one.kind === "directions")?.present(this.head) ?? [];
  }

  // The text in the panel of the directions while there are none.
  setDirectionHint(text) {
    for (const panel of this.panels) if (panel.kind === "directions") panel.hint = text;
  }

  #rangeUpdated = 0;

  #draw(stamp) {
    requestAnimationFrame((now) => this.#draw(now));
    const now = stamp / 1000;
    const head = this.frozen ?? this.clock.head(performance.now() / 1000);
    this.head = head;
    const updateRange = now - this.#rangeUpdated > RANGE_SECONDS;
    if (updateRange) this.#rangeUpdated = now;
    for (const panel of this.panels) {
      if (panel.canvas.unseen) continue;
      if (head !== null && (updateRange || !panel.range)) panel.updateRange(head, this.span, this.theme, now);
      panel.draw(head, this.span, this.theme, this.cursorX);
    }
  }

  // Save all panels as one PNG.
  async save() {
    const ratio = window.devicePixelRatio || 1;
    const canvases = this.panels.map((panel) => panel.canvas).filter((canvas) => canvas.width);
    if (!canvases.length) return;
    const image = document.createElement("canvas");
    const heading = 26 * ratio;
    const edge = 12 * ratio;
    image.width = Math.max(...canvases.map((canvas) => canvas.width)) + 2 * edge;
    image.height = canvases.reduce((sum, canvas) => sum + canvas.height + heading, edge);
    const context = image.getContext("2d");
    context.fillStyle = this.theme.surface;
    context.fillRect(0, 0, image.width, image.height);
    let y = 0;
    for (const panel of this.panels.filter((one) => one.canvas.width)) {
      context.fillStyle = this.theme.text;
      context.font = `600 ${13 * ratio}px ${this.theme.font}`;
      context.textBaseline = "middle";
      const text = panel.heading.textContent;
      context.fillText(text, edge, y + heading / 2 + 3 * ratio);
      const width = context.measureText(text).width;
      context.fillStyle = this.theme.muted;
      context.font = `${12 * ratio}px ${this.theme.font}`;
      context.fillText(panel.key.name, edge + width + 9 * ratio, y + heading / 2 + 3 * ratio);
      context.drawImage(panel.canvas, edge, y + heading);
      y += heading + panel.canvas.height;
    }
    const blob = await new Promise((resolve) => image.toBlob(resolve, "image/png"));
    download(blob, `rosafe-${new Date().toISOString().slice(0, 19).replace(/[:T]/g, "-")}.png`);
  }
}
