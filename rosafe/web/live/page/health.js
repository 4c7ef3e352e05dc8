// The Health section: delays, load, losses and failures.

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
    const latencies = tree.map((one) => status.latencies[one.topic]).filter((one) => one !== undefined);
    const silent = status.silent === null || status.silent > 2;
    const milliseconds = (value) => (silent || value === null ? "–" : `${(value * 1e3).toFixed(0)} ms`);
    this.#show([
      ["Audio delay", milliseconds(status.delay), "from the capture of the newest sample to its arrival at this server"],
      ["Plot delay", milliseconds(latencies.length ? Math.max(...latencies) : null), "from the capture of the newest sample of a block to the arrival of its results at this server; the slowest port shown"],
      ["Load of all processors", `${load.toFixed(0)} ms/s`, "computing time per second"],
      ["Lost frames", String(status.lost), "of the audio, since the nodes started"],
      ["Data rate", `${(link.rate / 1000).toFixed(0)} kB/s`, "received by this page"],
    ]);
    this.failures.hidden = !status.failures.length;
    this.failures.replaceChildren(...status.failures.map((text) => el("li", { text })));
    this.losses.hidden = !status.losses.length;
    this.losses.replaceChildren(...status.losses.map((loss) => el("li", {}, el("time", { text: new Date(loss.at * 1000).toLocaleTimeString() }), loss.what)));
  }

  #show(facts) {
    this.facts.replaceChildren(...facts.flatMap(([name, value, explanation]) => [el("dt", { text: name, title: explanation }), el("dd", { text: value })]));
  }
}
