// The tree of processors: loads, states, and one processor's parameters; adding and removing.

import { title } from "./panel.js";
import { el, offer, svg, toast, tried } from "./ui.js";

const EYE = "M2 12s3.6-6.5 10-6.5S22 12 22 12s-3.6 6.5-10 6.5S2 12 2 12zM12 9.2a2.8 2.8 0 1 0 0 5.6 2.8 2.8 0 0 0 0-5.6z";

export class TreeView {
  constructor(link, element, details, pictures, catalogue, watch) {
    Object.assign(this, { link, element, details, pictures, catalogue, watch });
    this.processors = [];
    this.loads = {};
    this.chosen = null;
    this.rows = el("ul");
    this.rowsBy = new Map();
    const add = el("button", { class: "more", text: "Add…", title: "Add a representation", onclick: () => this.#dialog() });
    const file = el("input", { type: "file", accept: ".yaml,.yml", hidden: true, id: "setup-file", onchange: () => this.#load(file) });
    const setups = el("div", { class: "row setups" },
      el("button", { class: "quiet", id: "save-setup", text: "Save setup", title: "Save tree and sound as a file", onclick: () => this.#save() }),
      ...(watch ? [] : [el("button", { class: "quiet", text: "Load setup…", title: "Build what a file says, wholly or not at all", onclick: () => file.click() }), file]));
    this.refusal = el("p", { class: "error", role: "alert" });
    this.refused = new Map(); // why, by the name of the chosen processor's parameter: its fields may be made anew meanwhile
    element.replaceChildren(el("div", { class: "head" }, el("h2", { text: "Processors" }), ...(watch ? [] : [add])), this.rows, setups, this.refusal);
    pictures.addEventListener("change", () => this.#eyes());
  }

  tree(processors) {
    this.processors = processors;
    const depth = new Map();
    const ordered = [];
    const walk = (parent, level) => {
      for (const one of processors.filter((each) => each.parent === parent)) {
        depth.set(one.name, level);
        ordered.push(one);
        walk(one.name, level + 1);
      }
    };
    walk("", 0);
    this.rowsBy.clear();
    this.rows.replaceChildren(...ordered.map((one) => this.#row(one, depth.get(one.name))));
    if (!ordered.length) this.rows.append(el("li", { class: "help", text: "There are none yet." }));
    this.#eyes();
    this.status({ loads: this.loads });
    const still = processors.find((one) => one.name === this.chosen);
    if (!still) this.#choose(null);
    else if (!this.details.contains(document.activeElement)) this.#choose(still);
  }

  #row(one, level) {
    const load = el("span", { class: "load", title: "computing, per second" });
    const eye = el("button", { class: "eye", "aria-label": `picture of ${one.name}`, title: "Show or hide its picture", onclick: () => this.pictures.toggle(one) }, svg(EYE));
    const name = el("button", { class: "name", title: `${one.name}: ${this.catalogue.kinds[one.kind]?.doc ?? one.kind}`, onclick: () => this.#click(one) },
      el("b", { text: one.name }), el("span", { text: one.name === one.kind ? "" : one.kind }));
    name.style.paddingLeft = `${6 + 9 * level}px`;
    const row = el("li", { class: "node" }, name, load, eye);
    this.rowsBy.set(one.name, { row, load, eye });
    return row;
  }

  #eyes() {
    for (const [name, { row, eye }] of this.rowsBy) {
      eye.setAttribute("aria-pressed", String(this.pictures.isOpen(name)));
      row.classList.toggle("chosen", name === this.chosen);
    }
  }

  status(status) {
    this.loads = status.loads;
    for (const [name, { load }] of this.rowsBy) {
      const told = status.loads[name];
      const bar = el("i");
      bar.style.width = `${Math.min(100, told ? told.load / 2 : 0)}%`; // all of it: 200 ms/s
      load.classList.toggle("hot", Boolean(told && told.load > 500));
      load.replaceChildren(told ? `${told.load.toFixed(told.load < 10 ? 1 : 0)} ms/s` : "", bar);
      load.title = told ? `${told.state}, ${told.blocks} blocks` : "";
    }
    if (this.state && this.chosen) this.state.textContent = this.#state();
  }

  #state() {
    const told = this.loads[this.chosen];
    return told ? `${told.state}, ${told.blocks} blocks, ${told.load.toFixed(1)} ms/s` : "";
  }

  // --- setups ---

  async #save() {
    const saved = await tried(this.link.ask("save"));
    if (saved) offer(new Blob([saved.setup], { type: "application/yaml" }), "setup.yaml");
  }

  async #load(file) {
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    this.refusal.textContent = "";
    try {
      const made = await this.link.ask("load", { setup: await chosen.text() });
      toast(made.created.length ? `built ${made.created.join(", ")}` : "all of it is there already");
    } catch (problem) {
      this.refusal.textContent = problem.message;
    }
  }

  // --- one processor ---

  #click(one) {
    this.refused.clear();
    this.#choose(this.chosen === one.name ? null : one);
    if (this.chosen) this.details.scrollIntoView({ block: "nearest", behavior: "smooth" });
  }

  #choose(one) {
    this.chosen = one?.name ?? null;
    this.details.hidden = !one;
    this.#eyes();
    if (!one) return;
    const kind = this.catalogue.kinds[one.kind];
    const above = one.kind === "input" ? this.catalogue.input : {};
    const below = this.#below(one.name);
    const remove = el("button", { class: "quiet more", text: "Remove", onclick: () => this.#remove(one, below) });
    this.state = el("p", { class: "help", text: this.#state() });
    this.details.replaceChildren(
      el("div", { class: "head" }, el("h2", { text: one.name }), ...(this.watch || !one.parent ? [] : [remove])),
      el("p", { class: "help", text: kind?.doc ?? one.kind }), this.state,
      el("div", { class: "fields" },
        ...Object.entries(kind?.parameters ?? {}).map(([name, parameter]) => this.#field(one, name, parameter)),
        ...Object.entries(above).map(([name, parameter]) => this.#field(one, name, parameter, true))),
      el("p", { class: "help", text: one.topic }),
    );
  }

  #field(one, name, parameter, fixed = false) {
    const value = one.values[name] ?? "";
    const why = this.refused.get(name) ?? "";
    const problem = el("p", { class: "error", role: "alert", hidden: !why, text: why });
    problem.id = `e-${one.name}-${name}`;
    const input = control(parameter, value);
    input.id = `p-${one.name}-${name}`;
    input.dataset.parameter = name;
    input.disabled = this.watch || fixed;
    const field = el("div", { class: "field" }, el("label", { for: input.id, text: name }, parameter.unit ? el("span", { class: "unit", text: ` ${parameter.unit}` }) : ""), input,
      el("p", { class: "help", text: help(parameter) + (fixed ? "; set when the input was made" : "") }), problem);
    input.addEventListener("change", async () => {
      try {
        await this.link.ask("modify", { nameProc: one.name, nameParam: name, newValue: read(input) });
        this.#tell(one, name, "");
        field.classList.add("done");
        setTimeout(() => field.classList.remove("done"), 1200);
      } catch (refusal) {
        this.#tell(one, name, refusal.message);
        write(input, this.processors.find((each) => each.name === one.name)?.values[name] ?? value);
      }
    });
    return field;
  }

  #tell(one, name, why) {
    if (this.chosen !== one.name) return;
    if (why) this.refused.set(name, why);
    else this.refused.delete(name);
    const problem = document.getElementById(`e-${one.name}-${name}`);
    if (problem) Object.assign(problem, { textContent: why, hidden: !why });
  }

  #below(name) {
    const children = this.processors.filter((one) => one.parent === name).map((one) => one.name);
    return [...children, ...children.flatMap((child) => this.#below(child))];
  }

  #remove(one, below) {
    const dialog = document.getElementById("dialog");
    const go = el("button", { class: "primary", text: "Remove", onclick: async () => {
      dialog.close();
      await tried(this.link.ask("remove", { name: one.name }), `${one.name} is removed`);
    } });
    dialog.replaceChildren(
      el("h2", { text: `Remove ${one.name}?` }),
      el("p", { text: below.length ? `What hangs on it goes too: ${below.join(", ")}.` : "Nothing else hangs on it." }),
      el("div", { class: "row end" }, el("button", { text: "Keep it", onclick: () => dialog.close() }), go));
    dialog.showModal();
  }

  // --- one more ---

  #dialog() {
    const dialog = document.getElementById("dialog");
    const kinds = Object.entries(this.catalogue.kinds).filter(([kind]) => kind !== "input");
    const choice = el("select", { "aria-label": "representation" }, ...kinds.map(([kind]) => el("option", { value: kind, text: `${title(kind)} (${kind})` })));
    const doc = el("p", { class: "help" });
    const groups = el("div", {});
    const problem = el("p", { class: "error", role: "alert" });
    const go = el("button", { class: "primary", text: "Build" });
    const show = () => {
      const kind = this.catalogue.kinds[choice.value];
      doc.textContent = `${kind.doc}. Built with all that it needs; what is there with the same parameters is used.`;
      groups.replaceChildren(...[...kind.chain].reverse().map((name, index) => {
        const { parameters } = this.catalogue.kinds[name];
        if (!Object.keys(parameters).length) return "";
        return el("details", { open: index === 0 }, el("summary", { text: `Parameters of ${name}` }),
          el("div", { class: "fields" }, ...Object.entries(parameters).map(([id, parameter]) => {
            const input = control(parameter, "");
            input.dataset.given = id;
            if (input.tagName === "SELECT") input.prepend(el("option", { value: "", text: `default: ${parameter.default}`, selected: true }));
            else if (input.type === "checkbox") input.checked = Boolean(parameter.default);
            else input.placeholder = String(parameter.default);
            if (input.type === "checkbox") input.dataset.default = String(Boolean(parameter.default));
            return el("div", { class: "field" }, el("label", {}, id, parameter.unit ? el("span", { class: "unit", text: ` ${parameter.unit}` }) : ""), input, el("p", { class: "help", text: help(parameter) }));
          })));
      }));
    };
    choice.addEventListener("change", show);
    choice.value = "itd" in this.catalogue.kinds ? "itd" : choice.value;
    show();
    go.addEventListener("click", async () => {
      const given = { representation: choice.value };
      for (const input of groups.querySelectorAll("[data-given]")) {
        const text = read(input);
        if (input.type === "checkbox" ? String(input.checked) !== input.dataset.default : text !== "") given[input.dataset.given] = text;
      }
      problem.textContent = "";
      go.disabled = true;
      try {
        const made = await this.link.ask("build", given);
        dialog.close();
        toast(made.created.length ? `built ${made.created.join(", ")}` : `${made.name} is there already`);
        this.wanted = made.name;
      } catch (refusal) {
        problem.textContent = refusal.message;
      }
      go.disabled = false;
    });
    dialog.replaceChildren(el("h2", { text: "Add a representation" }), choice, doc, groups, problem,
      el("div", { class: "row end" }, el("button", { text: "Cancel", onclick: () => dialog.close() }), go));
    choice.style.width = "100%";
    dialog.showModal();
  }
}

function control(parameter, value) {
  if (parameter.choices.length && !parameter.type.startsWith("sequence")) {
    const options = parameter.choices.includes(value) || value === "" ? parameter.choices : [value, ...parameter.choices];
    return el("select", {}, ...options.map((choice) => el("option", { value: choice, text: choice, selected: choice === value })));
  }
  if (parameter.type === "boolean") return el("input", { type: "checkbox", checked: value === "1" || value === "true" });
  // A text, whatever it holds: the component itself says what it does not take, and why.
  return el("input", { type: "text", inputmode: /sequence|string/.test(parameter.type) ? "text" : "decimal", value, spellcheck: "false", autocomplete: "off" });
}

function read(input) {
  if (input.type === "checkbox") return input.checked ? "1" : "0";
  return input.value.trim();
}

function write(input, value) {
  if (input.type === "checkbox") input.checked = value === "1";
  else input.value = value;
}

function help(parameter) {
  const range = parameter.range ? `; ${parameter.range}` : "";
  const usual = parameter.default === "" || (Array.isArray(parameter.default) && !parameter.default.length) ? "" : `; default ${parameter.default === true ? 1 : parameter.default === false ? 0 : parameter.default}`;
  return parameter.doc + range + usual;
}
