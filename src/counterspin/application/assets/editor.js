// @ts-check
// A file as a form and as text, which always agree; the text is the source.

import { RequestError, send } from "./api.js";
import { labelled, make, say, warning, working } from "./dom.js";
import { machineDrawing } from "./drawings.js";
import { linkedText, manualLink } from "./manual.js";

/**
 * @typedef {string | number} Part
 * @typedef {import("./answers.js").FormField & {visible?: boolean}} Field
 * @typedef {import("./answers.js").FormSection} Section
 * @typedef {import("./answers.js").EditedDocument} Edited
 */

/**
 * The path of a key in the notation of messages.
 * @param {Part[]} path
 */
export const keyPath = (path) => path.reduce((/** @type {string} */ text, part) => {
  if (typeof part === "number") return `${text}[${part}]`;
  const isBare = /^[\p{L}\p{N}]+$/u.test(part.replaceAll("_", "").replaceAll("-", ""));
  return `${text}${text && "."}${isBare ? part : `"${part}"`}`;
}, "");

/** A number with an optional uncertainty, alone and before a unit. */
const NUMBER = String.raw`[+−-]?\s*[\d.]+(?:[eE][+-]?\d+)?`;
const QUANTITY_START = String.raw`^\s*(${NUMBER}(?:\s*(?:±|\+/-|\+-)\s*${NUMBER})?)\s*`;
const QUANTITY_WITHOUT_UNIT = new RegExp(`${QUANTITY_START}$`, "u");
const QUANTITY = new RegExp(String.raw`${QUANTITY_START}([^\d\s.±+-].*)$`, "u");

/**
 * The values of nested tables by dotted keys.
 * @param {any} table
 * @param {string} [prefix]
 * @returns {Record<string, any>}
 */
const flatten = (table, prefix = "") => Object.entries(table ?? {}).reduce((entries, [key, value]) => (
  value && typeof value === "object" && !Array.isArray(value)
    ? { ...entries, ...flatten(value, `${prefix}${key}.`) } : { ...entries, [prefix + key]: value }), {});

/** @param {any} value */
const formatValue = (value) => {
  if (value === undefined || value === null) return "";
  if (Array.isArray(value) && value.every((item) => typeof item === "string")) return value.join(", ");
  return typeof value === "object" ? JSON.stringify(value) : String(value);
};

/**
 * The value of an input; null if it is empty.
 * @param {string} text
 * @param {string} kind
 */
function parseValue(text, kind) {
  const trimmed = text.trim();
  if (!trimmed) return null;
  if (kind === "number" && Number.isFinite(Number(trimmed))) return Number(trimmed);
  if (/^[[{]/.test(trimmed)) {
    try {
      return JSON.parse(trimmed);
    } catch {
      return trimmed;
    }
  }
  return kind === "list" ? trimmed.split(",").map((item) => item.trim()).filter(Boolean) : trimmed;
}

/** Number of labels listed for folded fields. */
const MAX_LISTED_LABELS = 4;

/** Section -> label of the name of a new table. */
const NAME_PROMPTS = /** @type {Record<string, string>} */ ({
  accelerometers: "Name of the new accelerometer",
  specification: "Name of an accelerometer with separate limits",
  truth: "Accelerometer name, or spindle, platform, centrifuge, encoder or noise",
});

/**
 * The name of the drawing that explains a section.
 * @param {string} key
 * @param {Record<string, any>} document
 * @returns {string}
 */
function drawingName(key, document) {
  if (key === "accelerometers") return "accelerometer";
  const { about, columns } = document.readings ?? {};
  if (key === "readings") return about ? "tumble" : columns?.motion ? "arm" : "";
  return key === "centrifuge" && !document.readings ? "double-turntable" : "";
}

/**
 * The first labels, and the number of further labels.
 * @param {string[]} labels
 */
const listLabels = (labels) => labels.slice(0, MAX_LISTED_LABELS).join(", ")
  + (labels.length > MAX_LISTED_LABELS ? ` and ${labels.length - MAX_LISTED_LABELS} more` : "");

/** @param {any} choice */
const choiceLabel = (choice) => ({ "\t": "tab", " ": "space" })[String(choice)] ?? String(choice);

export class Editor {
  /**
   * @param {import("./answers.js").EditedFile} file the file with its form
   * @param {{result?: string, saved?: () => void, shown?: (now: Edited) => void}} [options]
   */
  constructor(file, options = {}) {
    /** @type {string} */ this.file = file.file;
    /** @type {string} */ this.version = file.version;
    /** @type {Section[]} */ this.form = file.form;
    /** @type {Edited} */ this.content = file;
    this.options = options;
    this.savedText = file.text;
    /** @type {Promise<void>} */ this.pending = Promise.resolve();
    this.fields = make("form", { class: "fields", onsubmit: (/** @type {Event} */ e) => e.preventDefault() });
    this.area = make("textarea", {
      spellcheck: false, rows: 30, value: file.text, oninput: () => this.textTyped(),
    });
    this.messages = make("div", { "aria-live": "polite" });
    this.button = make("button", { type: "button", class: "main", onclick: () => this.save() }, "Save");
    /** @type {string[]} texts before each change, the newest last */
    this.history = [];
    /** @type {string[]} texts before each Undo, the newest last */
    this.redoHistory = [];
    this.undoButton = make("button", { type: "button", disabled: true, onclick: () => this.moveInHistory(this.history, this.redoHistory) }, "Undo");
    this.redoButton = make("button", { type: "button", disabled: true, onclick: () => this.moveInHistory(this.redoHistory, this.history) }, "Redo");
    this.element = make("div", { class: "editor" },
      make("div", {}, this.messages, this.fields),
      make("div", { class: "file" }, labelled(`${this.file}, as text`, this.area),
        make("div", { class: "row" }, this.button, this.undoButton, this.redoButton)));
    this.show();
  }

  get isChanged() {
    return this.content.text !== this.savedText;
  }

  /**
   * Run tasks one after the other, so that responses stay in order.
   * @param {() => Promise<void>} work
   */
  enqueue(work) {
    this.pending = this.pending.then(work).catch((error) => {
      this.messages.prepend(warning(error.message));
    });
    return this.pending;
  }

  /** Store the current text for Undo, before another text replaces it. */
  storeHistory() {
    if (this.history.at(-1) !== this.content.text) this.history.push(this.content.text);
    this.redoHistory.length = 0;
    this.updateHistoryButtons();
  }

  /**
   * Return to the newest text of a list, and add the current text to another list.
   * @param {string[]} source
   * @param {string[]} target
   */
  moveInHistory(source, target) {
    return this.enqueue(async () => {
      const text = source.pop();
      if (text === undefined) return;
      target.push(this.content.text);
      this.updateHistoryButtons();
      this.applyContent(await send("POST", "check", { ...this.request(), text }));
    });
  }

  /** Enable Undo and Redo if there is a text to return to. */
  updateHistoryButtons() {
    this.undoButton.disabled = !this.history.length;
    this.redoButton.disabled = !this.redoHistory.length;
  }

  textTyped() {
    // Text typed without a pause is undone together.
    if (!this.typing) this.storeHistory();
    this.typing = true;
    this.content = { ...this.content, text: this.area.value };
    this.button.disabled = !this.isChanged && this.version !== "";
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.enqueue(async () => {
      this.typing = false;
      const response = await send("POST", "check", this.request());
      if (response.text === this.area.value) this.applyContent(response);
    }), 250);
  }

  request() {
    return { file: this.file, text: this.content.text, result: this.options.result };
  }

  /**
   * @param {Part[]} path
   * @param {any} value
   * @param {string} [kind]
   */
  change(path, value, kind = "") {
    return this.enqueue(async () => {
      let request, response;
      do {
        request = this.request();
        response = await send("POST", "change", { ...request, path, value, kind });
      } while (request.text !== this.content.text); // The text was edited meanwhile: change this one.
      if (response.text !== this.content.text) this.storeHistory();
      this.applyContent(response);
    });
  }

  /** @param {Edited} content */
  applyContent(content) {
    this.content = content;
    if (this.area.value !== content.text) this.area.value = content.text;
    this.show();
  }

  save() {
    const progress = working(`Saving ${this.file}`);
    this.messages.prepend(progress);
    return this.enqueue(async () => {
      try {
        const response = await send("PUT", "text", { ...this.request(), version: this.version });
        this.version = response.version;
        this.savedText = response.text;
        // The text may have been edited meanwhile.
        if (response.text === this.content.text) this.applyContent(response);
        say(`Saved ${this.file}.`);
        this.options.saved?.();
      } catch (error) {
        if (!(error instanceof RequestError && error.status === 409)) throw error;
        this.conflict(error);
      } finally {
        progress.remove();
      }
    });
  }

  /** @param {RequestError} error */
  conflict(error) {
    const { text, version } = error.body;
    const currentText = make("textarea", { readonly: true, rows: 12, value: text });
    const box = make("div", { class: "conflict" }, warning(error.message),
      labelled("Current file", currentText),
      make("div", { class: "row" },
        make("button", {
          type: "button",
          onclick: () => {
            this.version = version;
            this.savedText = text;
            this.content = { ...this.content, text };
            this.area.value = text;
            this.textTyped();
            box.remove();
          },
        }, "Load current file"),
        make("button", {
          type: "button",
          onclick: () => {
            this.version = version;
            this.savedText = text;
            box.remove();
            this.save();
          },
        }, "Overwrite current file")));
    this.messages.prepend(box);
  }

  // The form

  show() {
    const focused = /** @type {HTMLInputElement | null} */ (document.activeElement);
    const focusedId = focused && this.fields.contains(focused) ? focused.id : "";
    const focusedValue = focusedId && focused ? focused.value : "";
    const openStates = new Map([...this.fields.querySelectorAll("details")].map((details) => [details.id, details.open]));
    /** @type {Map<string, HTMLElement>} */
    this.containers = new Map();
    this.fields.replaceChildren(...this.form.map((section) => this.section(section)));
    this.fields.querySelectorAll("details").forEach((details) => {
      const wasOpen = openStates.get(details.id);
      if (wasOpen !== undefined) details.open = wasOpen;
    });
    this.showProblems();
    this.options.shown?.(this.content);
    this.button.disabled = !this.isChanged && this.version !== "";
    const control = focusedId && /** @type {HTMLInputElement | null} */ (document.getElementById(focusedId));
    if (control) {
      control.focus();
      if (control.type !== "checkbox" && control.value !== focusedValue && control.tagName === "INPUT") control.value = focusedValue;
    }
  }

  showProblems() {
    const { problems, questions } = this.content;
    /** @type {Node[]} */
    const list = [];
    for (const [index, { key, words: message }] of problems.entries()) {
      let containerKey = key;
      while (containerKey && !this.containers?.has(containerKey)) containerKey = containerKey.replace(/(\."[^"]*"|[.[][^.[]*|^[^.[]*)$/, "");
      const field = this.containers?.get(containerKey);
      const line = key ? `${key}: ${message}` : message;
      if (!field) {
        list.push(make("li", {}, line));
        continue;
      }
      // Not the key: keys may contain spaces, which separate ids.
      const id = `wrong-${index}`;
      const control = field.querySelector("input, select, textarea");
      control?.setAttribute("aria-invalid", "true");
      const ids = [control?.getAttribute("aria-describedby"), id].filter(Boolean);
      control?.setAttribute("aria-describedby", ids.join(" "));
      const mistake = make("span", { class: "wrong", id }, containerKey === key ? message : line);
      field.append(mistake);
      // The mistake refers to the previous value.
      control?.addEventListener("input", () => {
        control.removeAttribute("aria-invalid");
        mistake.remove();
      }, { once: true });
      for (let details = field.closest("details"); details; details = details.parentElement?.closest("details") ?? null) details.open = true;
      list.push(make("li", {}, make("a", {
        href: "#",
        onclick: (/** @type {Event} */ event) => {
          event.preventDefault();
          /** @type {HTMLElement | null} */ (control)?.focus();
        },
      }, line)));
    }
    this.messages.replaceChildren(
      problems.length ? make("div", { class: "warning" },
        make("p", {}, problems.length === 1 ? "One mistake:" : `${problems.length} mistakes:`),
        make("ul", {}, ...list))
        : make("p", { class: "quiet" }, "No mistakes."),
      ...questions.map((message) => make("p", { class: "quiet" }, message)));
  }

  /** @param {Section} section */
  section(section) {
    const { key, repeat } = section;
    const value = this.content.document[key];
    const exists = value !== undefined;
    const hasMissing = this.content.missing?.some(({ key: missingKey }) => missingKey.startsWith(`${key}.`));
    const details = make("details", { id: `s-${key}`, open: exists || hasMissing },
      make("summary", {}, key[0].toUpperCase() + key.slice(1).replaceAll("_", " ")),
      make("p", { class: "quiet" }, section.words, " ", manualLink("Documentation", section.explained, key)));
    this.containers?.set(key, details);
    const drawing = drawingName(key, this.content.document);
    if (drawing) details.append(machineDrawing(drawing));
    if (!repeat) {
      details.append(...this.group(section.fields, [key], value ?? {}));
      if (section.name_fields) {
        for (const [name, limits] of Object.entries(value ?? {})) {
          if (limits && typeof limits === "object") {
            details.append(this.entry(name, section.name_fields, [key, name], limits));
          }
        }
        details.append(this.addButton(key));
      }
    } else if (repeat === "names") {
      for (const name of Object.keys(value ?? {})) {
        const fields = section.table_fields?.[name] ?? section.fields;
        details.append(this.entry(name, fields, [key, name], value[name]));
      }
      details.append(this.addButton(key));
    } else {
      const entries = Array.isArray(value) ? value : [];
      entries.forEach((entry, index) => {
        const fields = section.reading_fields && this.content.run_kinds[index] === "reading"
          ? section.reading_fields : section.fields;
        details.append(this.entry(entry?.name ?? `${index + 1}`, fields, [key, index], entry));
      });
      details.append(make("button", {
        type: "button",
        onclick: () => this.change([key, entries.length], this.newEntry(key, entries)),
      }, `Add to ${key}`));
    }
    return details;
  }

  /**
   * @param {string} key
   * @param {any[]} entries
   */
  newEntry(key, entries) {
    if (key !== "runs") return {};
    const name = `run${entries.length + 1}`;
    const rate = entries.at(-1)?.rate;
    return { name, ...(rate ? { rate } : {}), record: `${name}.csv` };
  }

  /**
   * @param {string} title
   * @param {Field[]} fields
   * @param {Part[]} path
   * @param {any} value
   */
  entry(title, fields, path, value) {
    const box = make("details", { class: "entry", id: `s-${keyPath(path)}`, 
      "aria-label": title, open: path[0] !== "runs" },
      make("summary", {}, title),
      ...this.group(fields, path, value ?? {}),
      make("button", { type: "button", onclick: () => this.change(path, null) }, `Remove ${title}`));
    this.containers?.set(keyPath(path), box);
    return box;
  }

  /** @param {string} key */
  addButton(key) {
    const name = make("input", { autocomplete: "off", id: `new-${key}` });
    return make("div", { class: "row" }, labelled(NAME_PROMPTS[key] ?? "Name of the new entry", name),
      make("button", {
        type: "button",
        onclick: () => { if (name.value.trim()) this.change([key, name.value.trim()], {}); },
      }, `Add to ${key}`));
  }

  /**
   * Required and existing fields first, the others folded.
   * @param {Field[]} fields
   * @param {Part[]} path
   * @param {any} value
   */
  group(fields, path, value) {
    const shownFields = fields.filter(({ key, required, visible }) => required || visible || value[key] !== undefined);
    const otherFields = fields.filter((field) => !shownFields.includes(field));
    /** @type {HTMLElement[]} */
    const content = [make("div", { class: "grid" },
      ...shownFields.map((field) => this.field(field, [...path, field.key], value[field.key])))];
    if (otherFields.length) {
      content.push(make("details", { class: "optional", id: `m-${keyPath(path)}`, open: !shownFields.length },
        make("summary", {}, `More: ${listLabels(otherFields.map(({ label }) => label))}`),
        make("div", { class: "grid" },
          ...otherFields.map((field) => this.field(field, [...path, field.key], undefined)))));
    }
    return content;
  }

  /**
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @returns {HTMLElement}
   */
  field(field, path, value) {
    const key = keyPath(path);
    const id = `f-${key}`;
    const help = field.help
      ? make("p", { class: "help", id: `h-${key.replace(/\s/g, "_")}` }, ...linkedText(field.help, field.links)) : null;
    /** @type {HTMLElement} */
    let container;
    if (field.kind === "group") {
      container = make("fieldset", {}, make("legend", {}, field.label), help,
        ...(value !== undefined || field.required
          ? this.group(field.fields ?? [], path, typeof value === "object" ? value : {})
          : this.group((field.fields ?? []).map((nestedField) => ({ ...nestedField, required: false })), path, {})));
    } else if (field.kind === "table") {
      container = this.table(field, path, value, help);
    } else if (field.kind === "terms") {
      container = this.terms(field, path, value, help);
    } else {
      // The unit is outside the label, because screen readers announce the label of the control.
      const [control, unit] = field.kind === "quantity" ? this.quantity(field, path, value, id)
        : [this.control(field, path, value, id), null];
      container = make("div", { class: unit ? "field quantity" : "field" }, labelled(field.label, control), unit, help);
      if (help) control.setAttribute("aria-describedby", help.id);
    }
    this.containers?.set(key, container);
    return container;
  }

  /**
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @param {string} id
   */
  control(field, path, value, id) {
    const { kind } = field;
    if (kind === "flag") {
      return make("input", {
        id, type: "checkbox", checked: value === true,
        onchange: (/** @type {any} */ event) => this.change(path, event.target.checked ? true : null),
      });
    }
    if (kind === "choice") {
      const select = make("select", {
        id, onchange: (/** @type {any} */ event) => this.change(path,
          event.target.value === "" ? null : field.choices?.[Number(event.target.value)]),
      }, make("option", { value: "" }, ""),
      ...(field.choices ?? []).map((choice, index) =>
        make("option", { value: index, selected: choice === value }, choiceLabel(choice))));
      return select;
    }
    if (kind === "country" || kind === "language") {
      const options = Object.entries(field.names ?? {}).map(([code, name]) => ({ code, name }))
        .sort((first, second) => first.name.localeCompare(second.name));
      return make("select", {
        id, "aria-required": field.required ? "true" : null,
        onchange: (/** @type {any} */ event) => this.change(path, event.target.value || null),
      }, make("option", { value: "" }, ""),
      options.every(({ code }) => code !== value) && value ? make("option", { value, selected: true }, formatValue(value)) : null,
      ...options.map(({ code, name }) => make("option", { value: code, selected: code === value }, `${name} (${code})`)));
    }
    if (kind === "text" && Math.max(formatValue(value).length, field.example?.length ?? 0) > 50) {
      return make("textarea", {
        id, rows: 4, class: "words", value: formatValue(value), placeholder: field.example ?? null,
        "aria-required": field.required ? "true" : null,
        onchange: (/** @type {any} */ event) => this.change(path, parseValue(event.target.value, kind)),
      });
    }
    return make("input", {
      id,
      type: kind === "date" && /^(\d{4}-\d{2}-\d{2})?$/.test(formatValue(value)) ? "date" : "text",
      list: field.suggestions ? this.suggestions(field.suggestions) : null,
      value: formatValue(value),
      autocomplete: "off",
      spellcheck: false,
      placeholder: field.example ?? null,
      "aria-required": field.required ? "true" : null,
      onchange: (/** @type {any} */ event) => this.change(path, parseValue(event.target.value, kind),
        event.target.type === "date" && event.target.value ? "date" : ""),
    });
  }

  /**
   * A number with an optional uncertainty, and its unit; or other text.
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @param {string} id
   * @returns {[HTMLInputElement, HTMLSelectElement]}
   */
  quantity(field, path, value, id) {
    const [, numberText, unit] = QUANTITY.exec(formatValue(value)) ?? ["", formatValue(value), ""];
    const [, example] = QUANTITY.exec(field.example ?? "") ?? [];
    const units = [...new Set([...(unit ? [unit] : []), ...(field.units ?? [])])];
    const change = () => {
      const match = QUANTITY_WITHOUT_UNIT.exec(numberInput.value);
      this.change(path, match ? `${match[1]} ${unitSelect.value}` : numberInput.value.trim() || null);
    };
    const numberInput = make("input", {
      id, type: "text", value: numberText, autocomplete: "off", spellcheck: false,
      placeholder: example ?? field.example ?? null,
      list: field.suggestions ? this.suggestions(field.suggestions) : null,
      "aria-required": field.required ? "true" : null,
      onchange: change,
    });
    const unitSelect = make("select", {
      id: `u-${keyPath(path)}`, "aria-label": `Unit of ${field.label}`,
      onchange: () => { if (QUANTITY_WITHOUT_UNIT.test(numberInput.value)) change(); },
    }, ...units.map((unitName) => make("option", { value: unitName, selected: unitName === unit }, unitName)));
    return [numberInput, unitSelect];
  }

  /**
   * The id of a list of suggestions.
   * @param {string[]} values
   */
  suggestions(values) {
    const id = `list-${values.join("-").replace(/[^\w-]/g, "_")}`;
    if (!document.getElementById(id)) {
      document.body.append(make("datalist", { id }, ...values.map((value) => make("option", { value }))));
    }
    return id;
  }

  /**
   * Checkboxes for terms, with descriptions and prior information.
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @param {HTMLElement | null} help
   */
  terms(field, path, value, help) {
    const selectedTerms = /** @type {string[]} */ (typeof value === "string" ? [value] : Array.isArray(value) ? value : []);
    const rows = field.rows ?? [];
    const otherTerms = selectedTerms.filter((symbol) => rows.every(({ key }) => key !== symbol));
    const priors = this.priorTexts();
    const row = (/** @type {string} */ symbol, /** @type {string} */ description) => make("tr", {},
      make("td", {}, make("input", {
        type: "checkbox", id: `f-${keyPath(path)}.${symbol}`, "aria-label": `${field.label}: ${symbol}`,
        checked: selectedTerms.includes(symbol),
        onchange: (/** @type {any} */ event) => {
          const newTerms = event.target.checked ? [...selectedTerms, symbol] : selectedTerms.filter((otherSymbol) => otherSymbol !== symbol);
          this.change(path, newTerms.length ? newTerms : null);
        },
      })),
      make("th", { scope: "row" }, symbol), make("td", {}, description), make("td", {}, priors[symbol] ?? ""));
    return make("details", { class: "terms", id: `t-${keyPath(path)}`, open: selectedTerms.length > 0 },
      make("summary", {}, selectedTerms.length ? `${field.label}: ${selectedTerms.join(", ")}` : field.label), help,
      make("div", { class: "ticks" }, make("table", {},
        make("thead", {}, make("tr", {}, make("td", {}), ...["Term", "Description", "Prior information"]
          .map((description) => make("th", { scope: "col" }, description)))),
        make("tbody", {}, ...otherTerms.map((symbol) => row(symbol, "")),
          ...rows.map(({ key, words: description }) => row(key, description))))));
  }

  /** The prior information on each term in the description. */
  priorTexts() {
    const { model, accelerometers } = this.content.document;
    /** @type {Record<string, string>} */
    const priors = {};
    const addPrior = (/** @type {string} */ symbol, /** @type {string} */ text) => {
      priors[symbol] = priors[symbol] ? `${priors[symbol]}; ${text}` : text;
    };
    for (const [symbol, value] of Object.entries(flatten(model?.priors))) addPrior(symbol, formatValue(value));
    for (const [name, keys] of Object.entries(accelerometers ?? {})) {
      for (const [key, value] of Object.entries(keys && typeof keys === "object" ? keys : {})) {
        const symbol = /** @type {Record<string, string>} */ ({ bias: "K_F", scale_factor: "K_I" })[key] ?? key;
        if (typeof value === "string" && /^(K_|delta_)/.test(symbol)) addPrior(symbol, `${value} (${name})`);
      }
    }
    return priors;
  }

  /**
   * A table with arbitrary keys, such as priors of terms.
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @param {HTMLElement | null} help
   */
  table(field, path, value, help) {
    const rows = Object.entries(typeof value === "object" && value ? value : {}).map(([key, entry]) => {
      const entryPath = [...path, key];
      const container = labelled(key, make("input", {
        id: `f-${keyPath(entryPath)}`, value: formatValue(entry), autocomplete: "off", spellcheck: false,
        onchange: (/** @type {any} */ event) => this.change(entryPath, parseValue(event.target.value, "text")),
      }));
      this.containers?.set(keyPath(entryPath), container);
      return container;
    });
    const keyInput = make("input", { id: `nk-${keyPath(path)}`, autocomplete: "off" });
    const valueInput = make("input", { id: `nv-${keyPath(path)}`, autocomplete: "off" });
    return make("fieldset", {}, make("legend", {}, field.label), help, ...rows,
      make("div", { class: "row" }, labelled("New key", keyInput), labelled("New value", valueInput),
        make("button", {
          type: "button",
          onclick: () => {
            if (keyInput.value.trim() && valueInput.value.trim()) {
              this.change([...path, keyInput.value.trim()], parseValue(valueInput.value, "text"));
            }
          },
        }, "Add")));
  }
}

/** The editor of the current page. */
let currentEditor = /** @type {Editor | null} */ (null);
addEventListener("beforeunload", (event) => {
  if (currentEditor?.isChanged && currentEditor.element.isConnected) event.preventDefault();
});

/**
 * Make an editor that protects unsaved changes.
 * @param {import("./answers.js").EditedFile} file
 * @param {{result?: string, saved?: () => void, shown?: (now: Edited) => void}} [options]
 */
export const makeEditor = (file, options) => guardUnsaved(new Editor(file, options));

/**
 * Ask for confirmation before a page with unsaved changes is left.
 * @param {Editor} editor
 */
export function guardUnsaved(editor) {
  currentEditor = editor;
  return editor;
}

/** Return whether there are unsaved changes. */
export const hasUnsavedChanges = () => Boolean(currentEditor?.isChanged && currentEditor.element.isConnected);

