// The Processors section: the tree with loads and states, the parameters of one processor, adding and removing.

import { title } from "./panel.js";
import { download, el, reportErrors, svg, toast } from "./ui.js";

const EYE = "M2 12s3.6-6.5 10-6.5S22 12 22 12s-3.6 6.5-10 6.5S2 12 2 12zM12 9.2a2.8 2.8 0 1 0 0 5.6 2.8 2.8 0 0 0 0-5.6z";

export class TreeView {
  constructor(link, element, details, plots, catalogue, watch) {
    Object.assign(this, { link, element, details, plots, catalogue, watch });
    this.processors = [];
    this.loads = {};
    this.selected = null;
    this.rows = el("ul");
    this.rowsByName = new Map();
    const add = el("button", { class: "more", text: "Add…", title: "Add a representation", onclick: () => this.#dialog() });
    const file = el("input", { type: "file", accept: ".yaml,.yml", hidden: true, id: "setup-file", onchange: () => this.#load(file) });
    const setups = el("div", { class: "row setups" },
      el("button", { class: "quiet", id: "save-setup", text: "Save setup", title: "Save tree and audio input as a setup file", onclick: () => this.#save() }),
      ...(watch ? [] : [el("button", { class: "quiet", text: "Load setup…", title: "Build the tree of a setup file, completely or not at all", onclick: () => file.click() }), file]));
    this.error = el("p", { class: "error", role: "alert" });
    this.rejected = new Map(); // errors by parameter of the selected processor; kept when its fields are created again
    element.replaceChildren(el("div", { class: "head" }, el("h2", { text: "Processors" }), ...(watch ? [] : [add])), this.rows, setups, this.error);
    plots.addEventListener("change", () => this.#updateButtons());
  }

  update(processors) {
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
    this.rowsByName.clear();
    this.rows.replaceChildren(...ordered.map((one) => this.#row(one, depth.get(one.name))));
    if (!ordered.length) this.rows.append(el("li", { class: "help", text: "No processors yet." }));
    this.#updateButtons();
    this.status({ loads: this.loads });
    const selected = processors.find((one) => one.name === this.selected);
    if (!selected) this.#select(null);
    else if (!this.details.contains(document.activeElement)) this.#select(selected);
    else this.#updateFields(selected);
    this.#openBuilt();
  }

  // The tree can be known before the answer to the request, or after it.
  #openBuilt() {
    const built = this.processors.find((one) => one.name === this.openWhenBuilt);
    if (!built) return;
    this.openWhenBuilt = null;
    if (!this.plots.isOpen(built.name)) this.plots.toggle(built);
  }

  #row(one, level) {
    const load = el("span", { class: "load", title: "computing time per second" });
    const eye = el("button", { class: "eye", "aria-label": `plot of ${one.name}`, title: "Show or hide the plot", onclick: () => this.plots.toggle(one) }, svg(EYE));
    const name = el("button", { class: "name", title: `${one.name}: ${this.catalogue.kinds[one.kind]?.doc ?? one.kind}`, onclick: () => this.#click(one) },
      el("b", { text: one.name }), el("span", { text: one.name === one.kind ? "" : one.kind }));
    name.style.paddingLeft = `${6 + 9 * level}px`;
    const row = el("li", { class: "node" }, name, load, eye);
    this.rowsByName.set(one.name, { row, load, eye });
    return row;
  }

  #updateButtons() {
    for (const [name, { row, eye }] of this.rowsByName) {
      eye.setAttribute("aria-pressed", String(this.plots.isOpen(name)));
      row.classList.toggle("selected", name === this.selected);
    }
  }

  status(status) {
    this.loads = status.loads;
    for (const [name, { load: element }] of this.rowsByName) {
      const load = status.loads[name];
      const bar = el("i");
      bar.style.width = `${Math.min(100, load ? load.load / 2 : 0)}%`; // full width: 200 ms/s
      element.classList.toggle("hot", Boolean(load && load.load > 500));
      element.replaceChildren(load ? `${load.load.toFixed(load.load < 10 ? 1 : 0)} ms/s` : "", bar);
      element.title = load ? `${load.state}, ${load.blocks} blocks` : "";
    }
    if (this.state && this.selected) this.state.textContent = this.#state();
  }

  #state() {
    const load = this.loads[this.selected];
    return load ? `${load.state}, ${load.blocks} blocks, ${load.load.toFixed(1)} ms/s` : "";
  }

  // --- setups ---

  async #save() {
    const saved = await reportErrors(this.link.request("save"));
    if (saved) download(new Blob([saved.setup], { type: "application/yaml" }), "setup.yaml");
  }

  async #load(file) {
    const [setup] = file.files;
    file.value = "";
    if (!setup) return;
    this.error.textContent = "";
    try {
      const answer = await this.link.request("load", { setup: await setup.text() });
      toast(answer.created.length ? `built ${answer.created.join(", ")}` : "all processors exist already");
    } catch (problem) {
      this.error.textContent = problem.message;
    }
  }

  // --- the selected processor ---

  #click(one) {
    this.rejected.clear();
    this.#select(this.selected === one.name ? null : one);
    if (this.selected) this.details.scrollIntoView({ block: "nearest", behavior: "smooth" });
  }

  #select(one) {
    this.selected = one?.name ?? null;
    this.details.hidden = !one;
    this.#updateButtons();
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
    const reason = this.rejected.get(name) ?? "";
    const error = el("p", { class: "error", role: "alert", hidden: !reason, text: reason });
    error.id = `e-${one.name}-${name}`;
    const input = control(parameter, value);
    input.id = `p-${one.name}-${name}`;
    input.dataset.parameter = name;
    input.dataset.current = value; // of the component, as far as the page knows
    input.disabled = this.watch || fixed;
    const field = el("div", { class: "field" }, el("label", { for: input.id, text: name }, parameter.unit ? el("span", { class: "unit", text: ` ${parameter.unit}` }) : ""), input,
      el("p", { class: "help", text: help(parameter) + (fixed ? "; set when the input was created" : "") }), error);
    input.addEventListener("change", async () => {
      const newValue = read(input);
      try {
        await this.link.request("modify", { nameProc: one.name, nameParam: name, newValue });
        update(input, newValue);
        this.#showError(one, name, "");
        field.classList.add("done");
        setTimeout(() => field.classList.remove("done"), 1200);
      } catch (problem) {
        this.#showError(one, name, problem.message);
        write(input, input.dataset.current);
      }
    });
    return field;
  }

  // Called instead of #select while a field has the focus, which a new field would not have.
  #updateFields(one) {
    for (const input of this.details.querySelectorAll("[data-parameter]")) update(input, one.values[input.dataset.parameter] ?? "");
  }

  #showError(one, name, text) {
    if (this.selected !== one.name) return;
    if (text) this.rejected.set(name, text);
    else this.rejected.delete(name);
    const error = document.getElementById(`e-${one.name}-${name}`);
    if (error) Object.assign(error, { textContent: text, hidden: !text });
  }

  #below(name) {
    const children = this.processors.filter((one) => one.parent === name).map((one) => one.name);
    return [...children, ...children.flatMap((child) => this.#below(child))];
  }

  #remove(one, below) {
    const dialog = document.getElementById("dialog");
    const confirm = el("button", { class: "primary", text: "Remove", onclick: async () => {
      dialog.close();
      await reportErrors(this.link.request("remove", { name: one.name }), `removed ${one.name}`);
    } });
    dialog.replaceChildren(
      el("h2", { text: `Remove ${one.name}?` }),
      el("p", { text: below.length ? `The processors below it are removed as well: ${below.join(", ")}.` : "There are no processors below it." }),
      el("div", { class: "row end" }, el("button", { text: "Cancel", onclick: () => dialog.close() }), confirm));
    dialog.showModal();
  }

  // --- adding a representation ---

  #dialog() {
    const dialog = document.getElementById("dialog");
    const kinds = Object.entries(this.catalogue.kinds).filter(([kind]) => kind !== "input");
    const choice = el("select", { "aria-label": "representation" }, ...kinds.map(([kind]) => el("option", { value: kind, text: `${title(kind)} (${kind})` })));
    const doc = el("p", { class: "help" });
    const groups = el("div", {});
    const error = el("p", { class: "error", role: "alert" });
    const confirm = el("button", { class: "primary", text: "Build" });
    const show = () => {
      const kind = this.catalogue.kinds[choice.value];
      doc.textContent = `${kind.doc}. Built with all processors that it needs; existing ones with the same parameters are reused.`;
      groups.replaceChildren(...[...kind.chain].reverse().map((name, index) => {
        const { parameters } = this.catalogue.kinds[name];
        if (!Object.keys(parameters).length) return "";
        return el("details", { open: index === 0 }, el("summary", { text: `Parameters of ${name}` }),
          el("div", { class: "fields" }, ...Object.entries(parameters).map(([id, parameter]) => {
            const input = control(parameter, "");
            input.dataset.value = id;
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
    confirm.addEventListener("click", async () => {
      const values = { representation: choice.value };
      for (const input of groups.querySelectorAll("[data-value]")) {
        const text = read(input);
        if (input.type === "checkbox" ? String(input.checked) !== input.dataset.default : text !== "") values[input.dataset.value] = text;
      }
      error.textContent = "";
      confirm.disabled = true;
      try {
        const answer = await this.link.request("build", values);
        dialog.close();
        toast(answer.created.length ? `built ${answer.created.join(", ")}` : `${answer.name} exists already`);
        this.openWhenBuilt = answer.name;
        this.#openBuilt();
      } catch (problem) {
        error.textContent = problem.message;
      }
      confirm.disabled = false;
    });
    dialog.replaceChildren(el("h2", { text: "Add a representation" }), choice, doc, groups, error,
      el("div", { class: "row end" }, el("button", { text: "Cancel", onclick: () => dialog.close() }), confirm));
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
  // A text field: the component checks the value and explains its errors.
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

// Store a new value of the component, and show it unless the user has typed another one.
function update(input, value) {
  const edited = read(input) !== input.dataset.current;
  input.dataset.current = value;
  if (!edited) write(input, value);
}

function help(parameter) {
  const range = parameter.range ? `; ${parameter.range}` : "";
  const fallback = parameter.default === "" || (Array.isArray(parameter.default) && !parameter.default.length) ? "" : `; default ${parameter.default === true ? 1 : parameter.default === false ? 0 : parameter.default}`;
  return parameter.doc + range + fallback;
}
