// The level meters, and the Audio section: devices, start and stop of the capture.

import { el, reportErrors } from "./ui.js";

const FLOOR = -60; // dBFS, the left end of a bar
const HOLD_SECONDS = 1.5; // of the display of peaks and clipping

export class Meters {
  constructor(element) {
    this.rows = ["L", "R"].map((name) => {
      const row = { bar: el("i"), peak: el("b"), number: el("output", { text: "−∞" }), clip: el("span", { class: "clip", text: "CLIP", title: "samples at full scale" }), peakHold: -Infinity, peakAt: 0, clippedAt: -Infinity };
      element.append(el("span", { text: name }), el("div", { class: "meter", role: "meter", "aria-label": `${name} level in dBFS`, "aria-valuemin": String(FLOOR), "aria-valuemax": "0" }, row.bar, row.peak), row.number, row.clip);
      return row;
    });
  }

  // Columns with peak and RMS (dBFS) and the number of clipped samples of each ear.
  update(piece) {
    const now = performance.now() / 1000;
    this.rows.forEach((row, ear) => {
      const [peak, rms, clipped] = piece.values.subarray(piece.values.length - 6 + 3 * ear);
      for (let at = 3 * ear + 2; at < piece.values.length; at += 6) if (piece.values[at] > 0 && piece.count < 9) row.clippedAt = now;
      if (clipped) row.clippedAt = now;
      if (peak >= row.peakHold || now - row.peakAt > HOLD_SECONDS) {
        row.peakHold = peak;
        row.peakAt = now;
      }
      this.#show(row, rms, now);
    });
  }

  #show(row, rms, now) {
    const position = (level) => Math.max(0, Math.min(1, 1 - level / FLOOR));
    row.bar.style.clipPath = `inset(0 ${100 * (1 - position(rms))}% 0 0)`;
    row.peak.style.left = `${100 * position(row.peakHold)}%`;
    row.number.textContent = Number.isFinite(row.peakHold) ? row.peakHold.toFixed(1).replace("-", "−") : "−∞";
    row.bar.parentElement.setAttribute("aria-valuenow", Math.max(FLOOR, rms).toFixed(0));
    row.clip.classList.toggle("on", now - row.clippedAt < HOLD_SECONDS);
  }

  showSilence() {
    for (const row of this.rows) {
      row.peakHold = -Infinity;
      this.#show(row, -Infinity, performance.now() / 1000);
    }
  }
}

export class Source {
  constructor(link, element, watch) {
    this.link = link;
    this.device = el("input", { list: "devices", "aria-label": "device", placeholder: "device, such as scene: or plughw:1,0", spellcheck: "false", value: "scene:" });
    this.list = el("datalist", { id: "devices" });
    this.doc = el("p", { class: "help" });
    this.problem = el("p", { class: "error", role: "alert" });
    this.rate = el("input", { type: "number", min: "0", max: "768000", placeholder: "default", title: "Default: the rate of the file or bag; 44100 for other devices", "aria-label": "sample rate" });
    this.chunk = el("input", { type: "number", min: "1", max: "1000000", value: "2205", "aria-label": "frames per chunk" });
    this.start = el("button", { class: "primary", text: "Start", onclick: () => this.#start() });
    this.stop = el("button", { text: "Stop", onclick: () => this.#stop() });
    const more = el("details", {}, el("summary", { text: "Sample rate and chunk length" }),
      el("div", { class: "fields" },
        el("div", { class: "field" }, el("label", { text: "sampleRate (Hz)" }), this.rate),
        el("div", { class: "field" }, el("label", { text: "nFramesPerChunk" }), this.chunk)));
    this.summary = el("p", { class: "help" });
    element.replaceChildren(el("div", { class: "head" }, el("h2", { text: "Audio" })), this.summary,
      ...(watch ? [] : [el("div", { class: "row" }, el("span", { class: "grow row" }, this.device), this.start, this.stop), this.list, this.doc, more, this.problem]));
    this.device.style.width = "100%";
    this.device.addEventListener("input", () => this.#describe());
    this.device.addEventListener("focus", () => this.loadDevices());
    this.device.addEventListener("keydown", (event) => { if (event.key === "Enter") this.#start(); });
    this.devices = [];
  }

  async loadDevices() {
    const answer = await this.link.request("devices").catch(() => null);
    if (!answer) return;
    this.devices = answer.devices;
    this.list.replaceChildren(...answer.devices.map((device) => el("option", { value: device.name.replace(/PATH$/, ""), label: device.doc })));
    this.#describe();
  }

  #describe() {
    const name = this.device.value;
    const known = this.devices.find((device) => name.startsWith(device.name.replace(/PATH$/, "")));
    this.doc.textContent = known ? known.doc : "";
  }

  async #start() {
    this.problem.textContent = "";
    this.start.disabled = true;
    try {
      await this.link.request("acquire", { device: this.device.value.trim(), sampleRate: Number(this.rate.value), nFramesPerChunk: Number(this.chunk.value) });
    } catch (problem) {
      this.problem.textContent = problem.message;
    }
    this.start.disabled = false;
  }

  async #stop() {
    this.problem.textContent = "";
    await reportErrors(this.link.request("silence"));
  }

  status(status) {
    this.stop.disabled = !status.device;
    if (status.device) this.summary.textContent = `${status.device}${status.sampleRate ? ` at ${status.sampleRate} Hz` : ""}`;
    else this.summary.textContent = status.bass ? `idle${status.lastEnd && status.lastEnd !== "none" ? `; last: ${status.lastEnd}` : ""}` : "bass is not running: start bass-ros";
  }
}
