// The panels: which are open, what the server is asked for, and when they are drawn.

import { Panel, title } from "./panel.js";
import { Clock, Series } from "./series.js";
import { el, offer, store, stored } from "./ui.js";

const USUAL = ["ratemap", "ild", "crossCorrelation"]; // open by themselves
const MOST = 16; // views that the server gives a page
const FIT = 0.5; // seconds between two looks at the range of the numbers

const same = (a, b) => a.what === b.what && a.name === b.name && (a.what !== "picture" || (a.part === b.part && (a.row === b.row || a.row < 0)));

export class Pictures extends EventTarget {
  constructor(link, element) {
    super();
    this.link = link;
    this.element = element;
    this.panels = [];
    this.clock = new Clock();
    this.kinds = {};
    this.tree = [];
    this.closed = new Set(stored("closed", []));
    this.opened = stored("opened", []);
    this.span = stored("span", 10);
    this.frozen = null; // the head
    this.pointed = null;
    this.views = new Map(); // by number: what takes the columns
    this.meter = () => {};
    this.empty = el("div", { class: "card empty" });
    this.visible = new IntersectionObserver((entries) => {
      for (const entry of entries) entry.target.unseen = !entry.isIntersecting;
    });
    link.addEventListener("open", () => this.#ask());
    link.addEventListener("views", (event) => this.#views(event.detail.views));
    link.addEventListener("columns", (event) => this.#take(event.detail));
    link.addEventListener("close", () => this.#each((panel) => { panel.problem = "no connection"; }));
    requestAnimationFrame((now) => this.#draw(now));
  }

  // --- which are open ---

  grow(processors, well) {
    this.tree = processors;
    const names = new Set(processors.map((one) => one.name));
    if (well) {
      for (const panel of this.panels.filter((one) => !names.has(one.key.name))) this.#remove(panel);
      for (const kind of USUAL) {
        const first = processors.find((one) => one.kind === kind && !this.closed.has(one.name));
        if (first && !this.panels.some((panel) => panel.kind === kind)) this.#add(first, 0, -1);
      }
      for (const { name, part, row } of this.opened) {
        const one = processors.find((each) => each.name === name);
        if (one && !this.isOpen(name)) this.#add(one, part, row);
      }
    }
    this.#changed();
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
      this.#keep();
      this.#changed();
      this.panels.find((panel) => panel.key.name === processor.name)?.element.scrollIntoView({ block: "nearest" });
    }
  }

  close(panel) {
    this.closed.add(panel.key.name);
    this.#remove(panel);
    this.#keep();
    this.#changed();
  }

  choose(panel, row) {
    this.#turn(panel, { row });
  }

  turn(panel, part) {
    this.#turn(panel, { part, row: -1 });
  }

  #turn(panel, change) {
    Object.assign(panel.key, change);
    panel.view = null;
    this.#keep();
    this.#ask();
  }

  point(x) {
    this.pointed = x;
  }

  #add(processor, part, row) {
    const panel = new Panel({ what: "picture", name: processor.name, part, row }, this);
    panel.kind = processor.kind;
    panel.heading.textContent = title(processor.kind);
    const place = (kind) => (USUAL.includes(kind) ? USUAL.indexOf(kind) : USUAL.length);
    const before = this.panels.findIndex((one) => place(one.kind) > place(panel.kind));
    if (before < 0) this.panels.push(panel);
    else this.panels.splice(before, 0, panel);
    this.visible.observe(panel.canvas);
  }

  #remove(panel) {
    this.visible.unobserve(panel.canvas);
    this.panels = this.panels.filter((one) => one !== panel);
  }

  #keep() {
    this.opened = this.panels.filter((panel) => !USUAL.includes(panel.kind) || panel.key.part || panel.key.row >= 0).map((panel) => panel.key);
    store("opened", this.opened);
    store("closed", [...this.closed]);
  }

  #changed() {
    const wanted = this.panels.length ? this.panels.map((panel) => panel.element) : [this.empty];
    if (wanted.length !== this.element.children.length || wanted.some((one, index) => this.element.children[index] !== one)) this.element.replaceChildren(...wanted);
    this.#ask();
    this.dispatchEvent(new Event("change"));
  }

  // --- what the server is asked for ---

  #keys() {
    const keys = [{ what: "levels" }];
    for (const panel of this.panels) {
      const more = [{ ...panel.key }];
      if (panel.kind === "crossCorrelation") more.push({ what: "direction", name: panel.key.name });
      if (keys.length + more.length <= MOST) keys.push(...more);
      else panel.problem = "too many pictures: close another one";
    }
    return keys;
  }

  #asked = "";

  #ask(anew = false) {
    const keys = this.#keys();
    const text = JSON.stringify(keys);
    if (anew || text !== this.#asked) {
      this.#asked = text;
      this.link.ask("look", { keys, anew }).catch(() => { this.#asked = ""; });
    }
  }

  reconnect() {
    this.#asked = "";
    this.#ask();
  }

  #views(views) {
    this.views.clear();
    for (const view of views) {
      if (view.key.what === "levels") {
        if (view.number) this.views.set(view.number, (piece) => this.meter(piece));
        continue;
      }
      const wanted = { ...view.key };
      if (wanted.what === "picture") {
        const panel = this.panels.find((one) => same(one.key, wanted));
        if (!panel) continue;
        panel.problem = view.error ?? "";
        if (view.error !== undefined) continue;
        panel.describe(view, this.kinds);
        this.views.set(view.number, (piece, now) => {
          panel.take(piece);
          this.clock.note(panel.series, now);
        });
      } else {
        const panel = this.panels.find((one) => one.key.name === wanted.name && one.kind === "crossCorrelation");
        if (!panel || view.error !== undefined) continue;
        const old = panel.direction;
        panel.direction = { view, series: old && old.view.number === view.number ? old.series : new Series(1, view.rate) };
        this.views.set(view.number, (piece) => panel.direction.series.append(piece));
      }
    }
  }

  #take(piece) {
    const take = this.views.get(piece.number);
    if (take && (this.frozen === null || take.length === 1)) take(piece, performance.now() / 1000);
  }

  // --- drawing ---

  freeze(on) {
    if (on) {
      this.frozen = this.clock.head(performance.now() / 1000);
      if (this.frozen === null) return false;
    } else {
      this.frozen = null;
      this.clock.reset();
      this.#each((panel) => { panel.series?.clear(); panel.direction?.series.clear(); });
      this.#ask(true);
    }
    return this.frozen !== null;
  }

  // The direction of the source as it is shown at the right edge: the median of the last half second.
  heard() {
    const panel = this.panels.find((one) => one.direction?.series.next);
    const head = this.head;
    if (!panel || head === undefined || head === null) return null;
    const { view, series } = panel.direction;
    const lags = [];
    series.each(series.columnAt(head - 0.5), series.columnAt(head) + 1, ([lag]) => { if (Number.isFinite(lag)) lags.push(lag); });
    if (lags.length < 3) return null;
    lags.sort((a, b) => a - b);
    return { view, lag: lags[Math.floor(lags.length / 2)] };
  }

  #each(act) {
    this.panels.forEach(act);
  }

  #fitted = 0;

  #draw(stamp) {
    requestAnimationFrame((now) => this.#draw(now));
    const now = stamp / 1000;
    const head = this.frozen ?? this.clock.head(performance.now() / 1000);
    this.head = head;
    const fit = now - this.#fitted > FIT;
    if (fit) this.#fitted = now;
    for (const panel of this.panels) {
      if (panel.canvas.unseen) continue;
      if (head !== null && (fit || !panel.range)) panel.fit(head, this.span, this.theme, now);
      panel.draw(head, this.span, this.theme, this.pointed);
    }
  }

  // All panels below one another, as a PNG.
  async save() {
    const ratio = window.devicePixelRatio || 1;
    const canvases = this.panels.map((panel) => panel.canvas).filter((canvas) => canvas.width);
    if (!canvases.length) return;
    const sheet = document.createElement("canvas");
    const head = 26 * ratio;
    const edge = 12 * ratio;
    sheet.width = Math.max(...canvases.map((canvas) => canvas.width)) + 2 * edge;
    sheet.height = canvases.reduce((sum, canvas) => sum + canvas.height + head, edge);
    const pen = sheet.getContext("2d");
    pen.fillStyle = this.theme.surface;
    pen.fillRect(0, 0, sheet.width, sheet.height);
    let y = 0;
    for (const panel of this.panels.filter((one) => one.canvas.width)) {
      pen.fillStyle = this.theme.text;
      pen.font = `600 ${13 * ratio}px ${this.theme.font}`;
      pen.textBaseline = "middle";
      const words = panel.heading.textContent;
      pen.fillText(words, edge, y + head / 2 + 3 * ratio);
      const wide = pen.measureText(words).width;
      pen.fillStyle = this.theme.muted;
      pen.font = `${12 * ratio}px ${this.theme.font}`;
      pen.fillText(panel.key.name, edge + wide + 9 * ratio, y + head / 2 + 3 * ratio);
      pen.drawImage(panel.canvas, edge, y + head);
      y += head + panel.canvas.height;
    }
    const blob = await new Promise((resolve) => sheet.toBlob(resolve, "image/png"));
    offer(blob, `rosafe-${new Date().toISOString().slice(0, 19).replace(/[:T]/g, "-")}.png`);
  }
}
