// How well it goes: latency, load, what was lost and when.

import { el } from "./ui.js";

export class Health {
  constructor(element) {
    this.facts = el("dl", { class: "facts" });
    this.failures = el("ul", { class: "failures", hidden: true });
    this.losses = el("ul", { class: "losses", hidden: true });
    element.replaceChildren(el("div", { class: "head" }, el("h2", { text: "Health" })), this.facts, this.failures, this.losses);
  }

  status(status, tree, link) {
    const load = Object.values(status.loads).reduce((sum, one) => sum + one.load, 0);
    const delays = tree.map((one) => status.latencies[one.topic]).filter((one) => one !== undefined);
    const delay = (value) => (value === null || value === undefined || status.silent === null || status.silent > 2 ? "–" : `${(value * 1e3).toFixed(0)} ms`);
    this.#show([
      ["Sound until here", delay(status.delay), "from the capture of the newest sample until it was here"],
      ["Pictures until here", delay(delays.length ? Math.max(...delays) : null), "from the capture of the newest sample of a block until what was computed of it was here; the slowest port that is shown"],
      ["Load of all processors", `${load.toFixed(0)} ms/s`, "time spent computing in each second"],
      ["Lost frames", String(status.lost), "of the sound, since the nodes started"],
      ["To this page", `${(link.rate / 1000).toFixed(0)} kB/s`, "what this page receives"],
    ]);
    this.failures.hidden = !status.failures.length;
    this.failures.replaceChildren(...status.failures.map((text) => el("li", { text })));
    this.losses.hidden = !status.losses.length;
    this.losses.replaceChildren(...status.losses.map((loss) => el("li", {}, el("time", { text: new Date(loss.at * 1000).toLocaleTimeString() }), loss.what)));
  }

  #show(facts) {
    this.facts.replaceChildren(...facts.flatMap(([name, value, why]) => [el("dt", { text: name, title: why }), el("dd", { text: value })]));
  }
}
