// @ts-check
// A file as a form with the text beside it; the text is what counts, and both are always the same.

import { Refused, send } from "./api.js";
import { labelled, make, say, warning, working } from "./dom.js";
import { drawingOf } from "./drawings.js";
import { linked, manualLink } from "./manual.js";

/**
 * @typedef {string | number} Part
 * @typedef {import("./answers.js").FormField & {visible?: boolean}} Field
 * @typedef {import("./answers.js").FormSection} Section
 * @typedef {import("./answers.js").EditedDocument} Edited
 */

/**
 * The path of a key as messages have it.
 * @param {Part[]} path
 */
export const keyPath = (path) => path.reduce((/** @type {string} */ text, part) => {
  if (typeof part === "number") return `${text}[${part}]`;
  const plain = /^[\p{L}\p{N}]+$/u.test(part.replaceAll("_", "").replaceAll("-", ""));
  return `${text}${text && "."}${plain ? part : `"${part}"`}`;
}, "");

/** A number, perhaps with its uncertainty, by itself and before a unit. */
const NUMBER = String.raw`[+−-]?\s*[\d.]+(?:[eE][+-]?\d+)?`;
const BEGINNING = String.raw`^\s*(${NUMBER}(?:\s*(?:±|\+/-|\+-)\s*${NUMBER})?)\s*`;
const STATED = new RegExp(`${BEGINNING}$`, "u");
const QUANTITY = new RegExp(String.raw`${BEGINNING}([^\d\s.±+-].*)$`, "u");

/**
 * A table's values by keys with dots, as priors are named.
 * @param {any} table
 * @param {string} [before]
 * @returns {Record<string, any>}
 */
const flat = (table, before = "") => Object.entries(table ?? {}).reduce((all, [key, value]) => (
  value && typeof value === "object" && !Array.isArray(value)
    ? { ...all, ...flat(value, `${before}${key}.`) } : { ...all, [before + key]: value }), {});

/** @param {any} value */
const shown = (value) => {
  if (value === undefined || value === null) return "";
  if (Array.isArray(value) && value.every((one) => typeof one === "string")) return value.join(", ");
  return typeof value === "object" ? JSON.stringify(value) : String(value);
};

/**
 * What is typed, as a value; null: nothing.
 * @param {string} text
 * @param {string} kind
 */
function typed(text, kind) {
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
  return kind === "list" ? trimmed.split(",").map((one) => one.trim()).filter(Boolean) : trimmed;
}

/** Labels that are listed of what is folded away. */
const MOST_LISTED = 4;

/** Section -> what is asked of a table that is added. */
const ADDED = /** @type {Record<string, string>} */ ({
  accelerometers: "Name of the new accelerometer",
  specification: "Name of an accelerometer with separate limits",
  truth: "Accelerometer name, or spindle, platform, centrifuge, encoder or noise",
});

/**
 * The drawing that shows what the fields of a section mean.
 * @param {string} key
 * @param {Record<string, any>} document
 * @returns {string}
 */
function machineOf(key, document) {
  if (key === "accelerometers") return "accelerometer";
  const { about, columns } = document.readings ?? {};
  if (key === "readings") return about ? "tumble" : columns?.motion ? "arm" : "";
  return key === "centrifuge" && !document.readings ? "double-turntable" : "";
}

/**
 * The first of some labels, and how many more there are.
 * @param {string[]} labels
 */
const listed = (labels) => labels.slice(0, MOST_LISTED).join(", ")
  + (labels.length > MOST_LISTED ? ` and ${labels.length - MOST_LISTED} more` : "");

/** @param {any} choice */
const choiceWords = (choice) => ({ "\t": "tab", " ": "space" })[String(choice)] ?? String(choice);

export class Editor {
  /**
   * @param {import("./answers.js").EditedFile} told the file with its form
   * @param {{result?: string, saved?: () => void, shown?: (now: Edited) => void}} [more]
   */
  constructor(told, more = {}) {
    /** @type {string} */ this.file = told.file;
    /** @type {string} */ this.version = told.version;
    /** @type {Section[]} */ this.form = told.form;
    /** @type {Edited} */ this.now = told;
    this.more = more;
    this.saved = told.text;
    /** @type {Promise<void>} */ this.last = Promise.resolve();
    this.fields = make("form", { class: "fields", onsubmit: (/** @type {Event} */ e) => e.preventDefault() });
    this.area = make("textarea", {
      spellcheck: false, rows: 30, value: told.text, oninput: () => this.textTyped(),
    });
    this.notes = make("div", { "aria-live": "polite" });
    this.button = make("button", { type: "button", class: "main", onclick: () => this.save() }, "Save");
    /** @type {string[]} texts before each change, the newest last */
    this.history = [];
    /** @type {string[]} texts before each Undo, the newest last */
    this.undone = [];
    this.undoButton = make("button", { type: "button", disabled: true, onclick: () => this.step(this.history, this.undone) }, "Undo");
    this.redoButton = make("button", { type: "button", disabled: true, onclick: () => this.step(this.undone, this.history) }, "Redo");
    this.element = make("div", { class: "editor" },
      make("div", {}, this.notes, this.fields),
      make("div", { class: "file" }, labelled(`${this.file}, as text`, this.area),
        make("div", { class: "row" }, this.button, this.undoButton, this.redoButton)));
    this.show();
  }

  get changed() {
    return this.now.text !== this.saved;
  }

  /**
   * One thing after the other, so that no answer overtakes another.
   * @param {() => Promise<void>} work
   */
  next(work) {
    this.last = this.last.then(work).catch((error) => {
      this.notes.prepend(warning(error.message));
    });
    return this.last;
  }

  /** Keep the present text for Undo, before another one replaces it. */
  remember() {
    if (this.history.at(-1) !== this.now.text) this.history.push(this.now.text);
    this.undone.length = 0;
    this.showSteps();
  }

  /**
   * Return to the newest text of a list, and add the present text to another list.
   * @param {string[]} from
   * @param {string[]} to
   */
  step(from, to) {
    return this.next(async () => {
      const text = from.pop();
      if (text === undefined) return;
      to.push(this.now.text);
      this.showSteps();
      this.take(await send("POST", "check", { ...this.said(), text }));
    });
  }

  /** Enable Undo and Redo where there is a text to return to. */
  showSteps() {
    this.undoButton.disabled = !this.history.length;
    this.redoButton.disabled = !this.undone.length;
  }

  textTyped() {
    // What is typed without a pause is taken back together.
    if (!this.typing) this.remember();
    this.typing = true;
    this.now = { ...this.now, text: this.area.value };
    this.button.disabled = !this.changed && this.version !== "";
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.next(async () => {
      this.typing = false;
      const told = await send("POST", "check", this.said());
      if (told.text === this.area.value) this.take(told);
    }), 250);
  }

  said() {
    return { file: this.file, text: this.now.text, result: this.more.result };
  }

  /**
   * @param {Part[]} path
   * @param {any} value
   * @param {string} [kind]
   */
  change(path, value, kind = "") {
    return this.next(async () => {
      let before, changed;
      do {
        before = this.said();
        changed = await send("POST", "change", { ...before, path, value, kind });
      } while (before.text !== this.now.text); // The text was edited meanwhile: change this one.
      if (changed.text !== this.now.text) this.remember();
      this.take(changed);
    });
  }

  /** @param {Edited} told */
  take(told) {
    this.now = told;
    if (this.area.value !== told.text) this.area.value = told.text;
    this.show();
  }

  save() {
    const state = working(`Saving ${this.file}`);
    this.notes.prepend(state);
    return this.next(async () => {
      try {
        const told = await send("PUT", "text", { ...this.said(), version: this.version });
        this.version = told.version;
        this.saved = told.text;
        // The text may have been edited meanwhile.
        if (told.text === this.now.text) this.take(told);
        say(`Saved ${this.file}.`);
        this.more.saved?.();
      } catch (error) {
        if (!(error instanceof Refused && error.status === 409)) throw error;
        this.conflict(error);
      } finally {
        state.remove();
      }
    });
  }

  /** @param {Refused} refused */
  conflict(refused) {
    const { text, version } = refused.told;
    const theirs = make("textarea", { readonly: true, rows: 12, value: text });
    const box = make("div", { class: "conflict" }, warning(refused.message),
      labelled("Current file", theirs),
      make("div", { class: "row" },
        make("button", {
          type: "button",
          onclick: () => {
            this.version = version;
            this.saved = text;
            this.now = { ...this.now, text };
            this.area.value = text;
            this.textTyped();
            box.remove();
          },
        }, "Load current file"),
        make("button", {
          type: "button",
          onclick: () => {
            this.version = version;
            this.saved = text;
            box.remove();
            this.save();
          },
        }, "Overwrite current file")));
    this.notes.prepend(box);
  }

  // The form

  show() {
    const focused = /** @type {HTMLInputElement | null} */ (document.activeElement);
    const key = focused && this.fields.contains(focused) ? focused.id : "";
    const value = key && focused ? focused.value : "";
    const open = new Map([...this.fields.querySelectorAll("details")].map((d) => [d.id, d.open]));
    /** @type {Map<string, HTMLElement>} */
    this.places = new Map();
    this.fields.replaceChildren(...this.form.map((section) => this.section(section)));
    this.fields.querySelectorAll("details").forEach((details) => {
      const was = open.get(details.id);
      if (was !== undefined) details.open = was;
    });
    this.showProblems();
    this.more.shown?.(this.now);
    this.button.disabled = !this.changed && this.version !== "";
    const again = key && /** @type {HTMLInputElement | null} */ (document.getElementById(key));
    if (again) {
      again.focus();
      if (again.type !== "checkbox" && again.value !== value && again.tagName === "INPUT") again.value = value;
    }
  }

  showProblems() {
    const { problems, questions } = this.now;
    /** @type {Node[]} */
    const list = [];
    for (const [i, { key, words }] of problems.entries()) {
      let place = key;
      while (place && !this.places?.has(place)) place = place.replace(/(\."[^"]*"|[.[][^.[]*|^[^.[]*)$/, "");
      const field = this.places?.get(place);
      const line = key ? `${key}: ${words}` : words;
      if (!field) {
        list.push(make("li", {}, line));
        continue;
      }
      // No key: one may hold blanks, at which a list of ids is parted.
      const id = `wrong-${i}`;
      const control = field.querySelector("input, select, textarea");
      control?.setAttribute("aria-invalid", "true");
      const ids = [control?.getAttribute("aria-describedby"), id].filter(Boolean);
      control?.setAttribute("aria-describedby", ids.join(" "));
      const mistake = make("span", { class: "wrong", id }, place === key ? words : line);
      field.append(mistake);
      // A mistake is of the value before it was edited.
      control?.addEventListener("input", () => {
        control.removeAttribute("aria-invalid");
        mistake.remove();
      }, { once: true });
      for (let up = field.closest("details"); up; up = up.parentElement?.closest("details") ?? null) up.open = true;
      list.push(make("li", {}, make("a", {
        href: "#",
        onclick: (/** @type {Event} */ event) => {
          event.preventDefault();
          /** @type {HTMLElement | null} */ (control)?.focus();
        },
      }, line)));
    }
    this.notes.replaceChildren(
      problems.length ? make("div", { class: "warning" },
        make("p", {}, problems.length === 1 ? "One mistake:" : `${problems.length} mistakes:`),
        make("ul", {}, ...list))
        : make("p", { class: "quiet" }, "No mistakes."),
      ...questions.map((words) => make("p", { class: "quiet" }, words)));
  }

  /** @param {Section} section */
  section(section) {
    const { key, repeat } = section;
    const value = this.now.document[key];
    const here = value !== undefined;
    const lacks = this.now.missing?.some(({ key: missing }) => missing.startsWith(`${key}.`));
    const details = make("details", { id: `s-${key}`, open: here || lacks },
      make("summary", {}, key[0].toUpperCase() + key.slice(1).replaceAll("_", " ")),
      make("p", { class: "quiet" }, section.words, " ", manualLink("Documentation", section.explained, key)));
    this.places?.set(key, details);
    const shown = machineOf(key, this.now.document);
    if (shown) details.append(drawingOf(shown));
    if (!repeat) {
      details.append(...this.group(section.fields, [key], value ?? {}));
      if (section.of_names) {
        for (const [name, one] of Object.entries(value ?? {})) {
          if (one && typeof one === "object") {
            details.append(this.entry(name, section.of_names, [key, name], one));
          }
        }
        details.append(this.adding(key));
      }
    } else if (repeat === "names") {
      for (const name of Object.keys(value ?? {})) {
        const fields = section.of_tables?.[name] ?? section.fields;
        details.append(this.entry(name, fields, [key, name], value[name]));
      }
      details.append(this.adding(key));
    } else {
      const entries = Array.isArray(value) ? value : [];
      entries.forEach((entry, i) => {
        const fields = section.of_readings && this.now.run_kinds[i] === "reading"
          ? section.of_readings : section.fields;
        details.append(this.entry(entry?.name ?? `${i + 1}`, fields, [key, i], entry));
      });
      details.append(make("button", {
        type: "button",
        onclick: () => this.change([key, entries.length], this.another(key, entries)),
      }, `Add to ${key}`));
    }
    return details;
  }

  /**
   * @param {string} key
   * @param {any[]} entries
   */
  another(key, entries) {
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
    this.places?.set(keyPath(path), box);
    return box;
  }

  /** @param {string} key */
  adding(key) {
    const name = make("input", { autocomplete: "off", id: `new-${key}` });
    return make("div", { class: "row" }, labelled(ADDED[key] ?? "Name of the new entry", name),
      make("button", {
        type: "button",
        onclick: () => { if (name.value.trim()) this.change([key, name.value.trim()], {}); },
      }, `Add to ${key}`));
  }

  /**
   * Those that are needed or there first, the others on demand.
   * @param {Field[]} fields
   * @param {Part[]} path
   * @param {any} value
   */
  group(fields, path, value) {
    const seen = fields.filter(({ key, required, visible }) => required || visible || value[key] !== undefined);
    const others = fields.filter((field) => !seen.includes(field));
    /** @type {HTMLElement[]} */
    const content = [make("div", { class: "grid" },
      ...seen.map((field) => this.field(field, [...path, field.key], value[field.key])))];
    if (others.length) {
      content.push(make("details", { class: "optional", id: `m-${keyPath(path)}`, open: !seen.length },
        make("summary", {}, `More: ${listed(others.map(({ label }) => label))}`),
        make("div", { class: "grid" },
          ...others.map((field) => this.field(field, [...path, field.key], undefined)))));
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
      ? make("p", { class: "help", id: `h-${key.replace(/\s/g, "_")}` }, ...linked(field.help, field.links)) : null;
    /** @type {HTMLElement} */
    let place;
    if (field.kind === "group") {
      place = make("fieldset", {}, make("legend", {}, field.label), help,
        ...(value !== undefined || field.required
          ? this.group(field.fields ?? [], path, typeof value === "object" ? value : {})
          : this.group((field.fields ?? []).map((one) => ({ ...one, required: false })), path, {})));
    } else if (field.kind === "table") {
      place = this.table(field, path, value, help);
    } else if (field.kind === "terms") {
      place = this.terms(field, path, value, help);
    } else {
      // A unit stands beside the label, not in it, for a label is what is read out of its control.
      const [control, unit] = field.kind === "quantity" ? this.quantity(field, path, value, id)
        : [this.control(field, path, value, id), null];
      place = make("div", { class: unit ? "field quantity" : "field" }, labelled(field.label, control), unit, help);
      if (help) control.setAttribute("aria-describedby", help.id);
    }
    this.places?.set(key, place);
    return place;
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
        onchange: (/** @type {any} */ e) => this.change(path, e.target.checked ? true : null),
      });
    }
    if (kind === "choice") {
      const select = make("select", {
        id, onchange: (/** @type {any} */ e) => this.change(path,
          e.target.value === "" ? null : field.choices?.[Number(e.target.value)]),
      }, make("option", { value: "" }, ""),
      ...(field.choices ?? []).map((choice, i) =>
        make("option", { value: i, selected: choice === value }, choiceWords(choice))));
      return select;
    }
    if (kind === "country" || kind === "language") {
      const some = Object.entries(field.names ?? {}).map(([code, name]) => ({ code, name }))
        .sort((one, other) => one.name.localeCompare(other.name));
      return make("select", {
        id, "aria-required": field.required ? "true" : null,
        onchange: (/** @type {any} */ e) => this.change(path, e.target.value || null),
      }, make("option", { value: "" }, ""),
      some.every(({ code }) => code !== value) && value ? make("option", { value, selected: true }, shown(value)) : null,
      ...some.map(({ code, name }) => make("option", { value: code, selected: code === value }, `${name} (${code})`)));
    }
    if (kind === "text" && Math.max(shown(value).length, field.example?.length ?? 0) > 50) {
      return make("textarea", {
        id, rows: 4, class: "words", value: shown(value), placeholder: field.example ?? null,
        "aria-required": field.required ? "true" : null,
        onchange: (/** @type {any} */ e) => this.change(path, typed(e.target.value, kind)),
      });
    }
    return make("input", {
      id,
      type: kind === "date" && /^(\d{4}-\d{2}-\d{2})?$/.test(shown(value)) ? "date" : "text",
      list: field.suggestions ? this.suggestions(field.suggestions) : null,
      value: shown(value),
      autocomplete: "off",
      spellcheck: false,
      placeholder: field.example ?? null,
      "aria-required": field.required ? "true" : null,
      onchange: (/** @type {any} */ e) => this.change(path, typed(e.target.value, kind),
        e.target.type === "date" && e.target.value ? "date" : ""),
    });
  }

  /**
   * A number, perhaps with its uncertainty, and its unit; or else what is typed in their place.
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @param {string} id
   * @returns {[HTMLInputElement, HTMLSelectElement]}
   */
  quantity(field, path, value, id) {
    const [, stated, unit] = QUANTITY.exec(shown(value)) ?? ["", shown(value), ""];
    const [, example] = QUANTITY.exec(field.example ?? "") ?? [];
    const units = [...new Set([...(unit ? [unit] : []), ...(field.units ?? [])])];
    const change = () => {
      const alone = STATED.exec(number.value);
      this.change(path, alone ? `${alone[1]} ${choice.value}` : number.value.trim() || null);
    };
    const number = make("input", {
      id, type: "text", value: stated, autocomplete: "off", spellcheck: false,
      placeholder: example ?? field.example ?? null,
      list: field.suggestions ? this.suggestions(field.suggestions) : null,
      "aria-required": field.required ? "true" : null,
      onchange: change,
    });
    const choice = make("select", {
      id: `u-${keyPath(path)}`, "aria-label": `Unit of ${field.label}`,
      onchange: () => { if (STATED.test(number.value)) change(); },
    }, ...units.map((one) => make("option", { value: one, selected: one === unit }, one)));
    return [number, choice];
  }

  /**
   * The id of a list of what may be typed.
   * @param {string[]} words
   */
  suggestions(words) {
    const id = `list-${words.join("-").replace(/[^\w-]/g, "_")}`;
    if (!document.getElementById(id)) {
      document.body.append(make("datalist", { id }, ...words.map((value) => make("option", { value }))));
    }
    return id;
  }

  /**
   * Terms to tick: what each does, and what is known of it.
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @param {HTMLElement | null} help
   */
  terms(field, path, value, help) {
    const ticked = /** @type {string[]} */ (typeof value === "string" ? [value] : Array.isArray(value) ? value : []);
    const rows = field.rows ?? [];
    const others = ticked.filter((one) => rows.every(({ key }) => key !== one));
    const known = this.known();
    const row = (/** @type {string} */ symbol, /** @type {string} */ words) => make("tr", {},
      make("td", {}, make("input", {
        type: "checkbox", id: `f-${keyPath(path)}.${symbol}`, "aria-label": `${field.label}: ${symbol}`,
        checked: ticked.includes(symbol),
        onchange: (/** @type {any} */ e) => {
          const now = e.target.checked ? [...ticked, symbol] : ticked.filter((one) => one !== symbol);
          this.change(path, now.length ? now : null);
        },
      })),
      make("th", { scope: "row" }, symbol), make("td", {}, words), make("td", {}, known[symbol] ?? ""));
    return make("details", { class: "terms", id: `t-${keyPath(path)}`, open: ticked.length > 0 },
      make("summary", {}, ticked.length ? `${field.label}: ${ticked.join(", ")}` : field.label), help,
      make("div", { class: "ticks" }, make("table", {},
        make("thead", {}, make("tr", {}, make("td", {}), ...["Term", "Description", "Prior information"]
          .map((words) => make("th", { scope: "col" }, words)))),
        make("tbody", {}, ...others.map((one) => row(one, "")),
          ...rows.map(({ key, words }) => row(key, words))))));
  }

  /** What the description says of each term beforehand. */
  known() {
    const { model, accelerometers } = this.now.document;
    /** @type {Record<string, string>} */
    const found = {};
    const note = (/** @type {string} */ symbol, /** @type {string} */ words) => {
      found[symbol] = found[symbol] ? `${found[symbol]}; ${words}` : words;
    };
    for (const [symbol, value] of Object.entries(flat(model?.priors))) note(symbol, shown(value));
    for (const [name, keys] of Object.entries(accelerometers ?? {})) {
      for (const [key, value] of Object.entries(keys && typeof keys === "object" ? keys : {})) {
        const symbol = /** @type {Record<string, string>} */ ({ bias: "K_F", scale_factor: "K_I" })[key] ?? key;
        if (typeof value === "string" && /^(K_|delta_)/.test(symbol)) note(symbol, `${value} (${name})`);
      }
    }
    return found;
  }

  /**
   * A table of keys that no form knows beforehand, such as priors of terms.
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   * @param {HTMLElement | null} help
   */
  table(field, path, value, help) {
    const rows = Object.entries(typeof value === "object" && value ? value : {}).map(([key, one]) => {
      const inner = [...path, key];
      const place = labelled(key, make("input", {
        id: `f-${keyPath(inner)}`, value: shown(one), autocomplete: "off", spellcheck: false,
        onchange: (/** @type {any} */ e) => this.change(inner, typed(e.target.value, "text")),
      }));
      this.places?.set(keyPath(inner), place);
      return place;
    });
    const key = make("input", { id: `nk-${keyPath(path)}`, autocomplete: "off" });
    const one = make("input", { id: `nv-${keyPath(path)}`, autocomplete: "off" });
    return make("fieldset", {}, make("legend", {}, field.label), help, ...rows,
      make("div", { class: "row" }, labelled("New key", key), labelled("New value", one),
        make("button", {
          type: "button",
          onclick: () => {
            if (key.value.trim() && one.value.trim()) {
              this.change([...path, key.value.trim()], typed(one.value, "text"));
            }
          },
        }, "Add")));
  }
}

/** The editors of a page that is left with unsaved changes. */
let current = /** @type {Editor | null} */ (null);
addEventListener("beforeunload", (event) => {
  if (current?.changed && current.element.isConnected) event.preventDefault();
});

/**
 * Make an editor that is asked about before the page is left.
 * @param {import("./answers.js").EditedFile} told
 * @param {{result?: string, saved?: () => void, shown?: (now: Edited) => void}} [more]
 */
export const editorOf = (told, more) => guardUnsaved(new Editor(told, more));

/**
 * Ask before the page of an editor is left with unsaved changes.
 * @param {Editor} editor
 */
export function guardUnsaved(editor) {
  current = editor;
  return editor;
}

/** Tell whether there are changes that would be lost. */
export const unsaved = () => Boolean(current?.changed && current.element.isConnected);

