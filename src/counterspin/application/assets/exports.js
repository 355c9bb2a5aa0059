// @ts-check
// Exports of a recorder, dragged in: what is guessed of them is shown and may be changed, what they
// do not say is asked, and nothing is written before.

import { campaignAddress } from "./addresses.js";
import { bring, Refused, send } from "./api.js";
import { attempt, labelled, make, say, warning } from "./dom.js";
import { drawingOf } from "./drawings.js";

/**
 * What may be answered.
 * @typedef {{key: string, text: string, example: string, choices: string[], guess: string|null}} Question
 */

/**
 * Kind of test -> what only one column may be, what else a column may be, and what is said of one
 * that is neither.
 */
const ROLES = {
  "double-turntable": { parts: ["time", "angle"], others: ["displacement", "velocity", "specific_force", "unused"], blank: "choose" },
  "tumble": { parts: ["position"], others: ["reading", "uncertainty", "temperature", "time", "unused"], blank: "choose" },
  "arm": { parts: ["rate", "position"], others: ["radius", "reading", "uncertainty", "temperature", "time", "unused"], blank: "choose" },
  "poses": { parts: ["time", "X", "Y", "Z"], others: [], blank: "unused" },
};
const NONE = "none";
/** How often files are looked at anew after a change, while that brings up answers given before. */
const MOST_LOOKS = 4;

/** What begins a campaign from files. */
export function exportsPart() {
  const folder = make("input", { required: true, autocomplete: "off", placeholder: "my-campaign" });
  const test = make("select", {},
    make("option", { value: "" }, "Guess from the files"),
    make("option", { value: "double-turntable" }, "Records of a double turntable"),
    make("option", { value: "tumble" }, "Table of a tumble's readings"),
    make("option", { value: "arm" }, "Table of readings on an arm"),
    make("option", { value: "poses" }, "Record of a sensor in many poses"));
  const files = make("input", { type: "file", multiple: true, id: "exports" });
  const place = make("div");

  /** @type {string[]} those that were brought */
  let names = [];
  /** @type {Preview|null} */
  let preview = null;
  let guessed = "";
  const look = () => attempt(place, async () => {
    preview?.end();
    place.replaceChildren(make("p", { class: "quiet" }, "Looking at the files."));
    const stated = test.value;
    const own = preview = new Preview(place, names, () => folder.value, test.value, preview?.answers);
    await own.update();
    if (own !== preview) return;
    test.value = own.test;
    guessed = stated ? "" : own.test;
  });
  test.addEventListener("change", () => names.length ? look() : null);
  /** @param {File[]} some */
  const take = async (some) => {
    if (!some.length) return;
    if (!folder.value.trim()) {
      place.replaceChildren(warning("Enter a folder name first."));
      folder.focus();
      return;
    }
    // What other files are is guessed anew.
    if (test.value === guessed) test.value = "";
    await attempt(place, async () => {
      names = [];
      for (const file of some) {
        place.replaceChildren(make("p", { class: "quiet" }, `Uploading ${file.name}.`));
        names.push((await bring(`${folder.value.trim()}/${file.name}`, file)).name);
      }
      await look();
    });
  };
  files.addEventListener("change", () => take([...files.files ?? []]));
  const pasted = pastedTable(async (file) => {
    const readings = ["tumble", "arm"];
    if (!readings.includes(test.value)) test.value = "";
    await take([file]);
    // What is typed has readings: of a tumble, where it shows no rates.
    if (!test.value || readings.includes(test.value)) return;
    test.value = "tumble";
    await look();
  });
  const zone = make("div", { class: "drop" },
    make("div", { class: "row" }, labelled("Folder of the new campaign", folder), labelled("What the files are", test),
      labelled("The recorder's files, one for each run, or the table; or drag them here", files)), pasted, place);
  zone.addEventListener("dragover", (event) => {
    event.preventDefault();
    zone.classList.add("over");
  });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    take([...event.dataTransfer?.files ?? []]);
  });
  return zone;
}

/**
 * A table that is typed or pasted, as a file that is brought as any other.
 * @param {(file: File) => Promise<void>} take
 */
function pastedTable(take) {
  const text = make("textarea", { rows: 6, spellcheck: "false", autocomplete: "off",
    placeholder: "position_deg\treading_mA\n0\t1.2503\n30\t1.0825" });
  let looks = 0;
  return make("details", {}, make("summary", {}, "Type or paste a table, as copied from a spreadsheet"),
    labelled("Names of the columns, then a line for each reading", text),
    make("button", {
      type: "button",
      // A table that was changed is another file: none is replaced.
      onclick: () => take(new File([asTable(text.value)], `readings${looks++ ? `-${looks}` : ""}.txt`)),
    }, "Look at this table"));
}

/**
 * A text as lines of a file: those that are empty say nothing.
 * @param {string} text
 */
export const asTable = (text) =>
  `${text.split(/\r\n?|\n/).map((line) => line.trimEnd()).filter(Boolean).join("\n")}\n`;

/**
 * The answers to what is asked; an answer to another kind of test is kept for when it is chosen again.
 * @param {Question[]} questions
 * @param {Record<string, string>} answers by the keys of questions
 */
export const answersTo = (questions, answers) => Object.fromEntries(questions
  .filter(({ key, choices }) => key in answers && (!choices.length || choices.includes(answers[key])))
  .map(({ key }) => [key, answers[key]]));

/**
 * Look until no answer is left unsent, or often enough: an answer may lead to a question that is answered already.
 * @template T
 * @param {() => Promise<T|null>} look sends the answers; null: somebody else has asked meanwhile
 * @param {() => string[]} answered the questions known so far that are answered
 * @returns {Promise<T|null>} what the last look told
 */
export async function lookUntilSettled(look, answered) {
  for (let count = 1; ; count++) {
    const sent = answered();
    const told = await look();
    if (told === null || count === MOST_LOOKS || answered().every((key) => sent.includes(key))) return told;
  }
}

/** What is in the files, with a field for all that may be answered. */
class Preview {
  /**
   * @param {HTMLElement} place
   * @param {string[]} names of the files
   * @param {() => string} folder of the new campaign
   * @param {string} test its kind; empty: to be guessed
   * @param {Record<string, string>} answers said already, of the same or another kind of test
   */
  constructor(place, names, folder, test, answers = {}) {
    this.test = test;
    this.place = place;
    this.names = names;
    this.folder = folder;
    /** @type {Record<string, string>} what a person has said, by the keys of questions */
    this.answers = answers;
    /** @type {Record<string, string>} those of them that this kind of test asks for */
    this.sent = {};
    /** @type {Question[]} of this kind of test, as far as they are known */
    this.questions = [];
    /** @type {Map<string, HTMLInputElement|HTMLSelectElement>} kept, so that nothing typed is lost */
    this.fields = new Map();
    this.asked = 0;
    /** @type {HTMLElement[]} of the machine, once its kind is known */
    this.drawing = [];
    /** @type {any} what the server says of the files */
    this.told = null;
    /** @type {Promise<void>} the last look after a change */
    this.last = Promise.resolve();
    this.above = make("div");
    this.asks = make("div");
    this.below = make("div");
    // The button stays where it is: who presses it while files are looked at anew has pressed it.
    this.form = make("form", { onsubmit: (/** @type {Event} */ event) => this.write(event), novalidate: true },
      this.asks, make("button", { class: "main" }, "Write the campaign"));
  }

  /** What is said of the files so far. */
  said() {
    this.sent = answersTo(this.questions, this.answers);
    return { names: this.names, answers: this.sent, test: this.test || null };
  }

  /** Show nothing more: another preview has taken the place. */
  end() {
    this.asked++;
  }

  /** What a column may be. */
  roles() {
    return ROLES[/** @type {keyof typeof ROLES} */ (this.test)] ?? { parts: [], others: [], blank: "choose" };
  }

  /** Ask what the files show with the answers so far, and show it. */
  async update() {
    const asked = ++this.asked;
    const told = await lookUntilSettled(async () => {
      const found = await send("POST", "draft", this.said());
      if (asked !== this.asked) return null;
      this.test = found.test ?? "";
      this.questions = found.questions;
      return found;
    }, () => Object.keys(answersTo(this.questions, this.answers)));
    if (told === null) return;
    this.said();
    if (this.test && !this.drawing.length) this.drawing = [drawingOf(this.test === "poses" ? "accelerometer" : this.test, true)];
    this.show(told, told.problems);
  }

  /**
   * @param {any} told
   * @param {string[]} problems a line each, which begins with the key of a question
   */
  show(told, problems) {
    /** @type {Map<string, Question>} */
    const questions = new Map(told.questions.map((/** @type {Question} */ one) => [one.key, one]));
    const wrong = new Map(problems.map((line) => {
      const key = [...questions.keys()].find((one) => line.startsWith(`${one}: `)) ?? "";
      const open = key && !(key in this.sent);
      return [key, open ? `Needed, such as ${questions.get(key)?.example}.` : line.slice(key ? key.length + 2 : 0)];
    }));
    const active = /** @type {HTMLElement} */ (document.activeElement);
    const table = this.table(told, questions, wrong);
    const shown = new Set(table.keys);
    const rest = [...questions.values()].filter((one) => !shown.has(one.key) && !one.key.endsWith(" is"));
    this.told = told;
    this.above.replaceChildren(
      make("h3", {}, `What is in ${told.file}${this.names.length > 1 ? " and the others" : ""}`),
      make("div", { class: "scroll", tabindex: "0" }, table.element),
      make("div", { class: "figures" }, ...(told.directions.length ? [circleOf(told.directions)] : []), ...this.drawing));
    this.asks.replaceChildren(make("div", { class: "grid" }, ...rest.map((one) => this.field(one, wrong))),
      ...(wrong.has("") ? [warning(/** @type {string} */ (wrong.get("")))] : []));
    this.below.replaceChildren(make("details", {}, make("summary", {}, "Seen in the files, in words"),
      make("ul", {}, ...told.statements.map((/** @type {string} */ one) => make("li", {}, one)))));
    if (!this.form.isConnected) this.place.replaceChildren(this.above, this.form, this.below);
    if (active?.isConnected) active.focus();
  }

  /**
   * The columns, with what each is taken for above its first values.
   * @param {any} told
   * @param {Map<string, Question>} questions
   * @param {Map<string, string>} wrong
   */
  table(told, questions, wrong) {
    const { parts } = this.roles();
    const keys = new Set(parts), readings = parts.includes("position");
    /** @type {Record<string, (Node|null)[]>} */
    const rows = { is: [], unit: [], axis: [], picture: [] };
    for (const { name, extent } of told.columns) {
      const part = parts.find((one) => (this.sent[one] ?? questions.get(one)?.guess) === name);
      const own = part ? [null, `${part} unit`, null] : ["is", "unit", "axis"].map((one) => `${name} ${one}`);
      const [unit, axis] = own.slice(1).map((key) => {
        const question = key && questions.get(key);
        if (!question) return null;
        keys.add(question.key);
        return this.field(question, wrong, true);
      });
      rows.is.push(this.kind(name, part, questions, wrong));
      rows.unit.push(unit);
      rows.axis.push(axis);
      rows.picture.push(extent.length ? picture(name, extent) : null);
    }
    const line = (/** @type {string} */ head, /** @type {(Node|string|null)[]} */ cells) =>
      make("tr", {}, make("th", { scope: "row" }, head), ...cells.map((cell) => make("td", {}, cell)));
    const count = Math.max(...told.columns.map((/** @type {any} */ one) => one.first.length));
    const element = make("table", { class: "preview" },
      make("thead", {}, make("tr", {}, make("td"),
        ...told.columns.map((/** @type {any} */ one) => make("th", { scope: "col" }, one.name)))),
      make("tbody", {}, line("is", rows.is), line("in", rows.unit), ...(rows.axis.some(Boolean) ? [line("along", rows.axis)] : []),
        line(readings ? "over the rows" : "over time", rows.picture),
        ...Array.from({ length: count }, (_, row) =>
          line(`row ${row + 1}`, told.columns.map((/** @type {any} */ one) => one.first[row] ?? "")))));
    return { element, keys };
  }

  /**
   * What a column is, as a choice.
   * @param {string} name
   * @param {string|undefined} part
   * @param {Map<string, Question>} questions
   * @param {Map<string, string>} wrong
   */
  kind(name, part, questions, wrong) {
    const value = part ?? this.sent[`${name} is`] ?? questions.get(`${name} is`)?.guess ?? "";
    const { parts, others, blank } = this.roles();
    const choices = [...new Set([...parts, ...questions.get(`${name} is`)?.choices ?? others])];
    const control = make("select", {
      "aria-label": `What is column ${name}?`,
      onchange: () => {
        for (const one of parts) {
          if (control.value === one) this.answers[one] = name;
          else if (one === part) {
            if (questions.get(one)?.choices.includes(NONE)) this.answers[one] = NONE;
            else delete this.answers[one];
          }
        }
        delete this.answers[`${name} is`];
        if (control.value && !parts.includes(control.value)) this.answers[`${name} is`] = control.value;
        this.last = this.changed();
      },
    }, ...(value ? [] : [""]).concat(choices).map((one) =>
      make("option", { value: one }, one.replace("_", " ") || blank)));
    control.value = value;
    return withMistake(control, wrong.get(`${name} is`));
  }

  /**
   * A field for an answer.
   * @param {Question} question
   * @param {Map<string, string>} wrong
   * @param {boolean} bare without its label
   */
  field(question, wrong, bare = false) {
    const { key, text, choices, example, guess } = question;
    const kept = this.fields.get(key);
    const made = kept ?? (choices.length
      ? make("select", {}, ...(guess === null ? [""] : []).concat(choices).map((one) =>
        make("option", { value: one }, one || "choose")))
      : make("input", { placeholder: example, autocomplete: "off", spellcheck: "false" }));
    if (!kept) {
      this.fields.set(key, made);
      made.value = this.sent[key] ?? "";
      const take = () => {
        const said = made.value.trim();
        if (said === (this.answers[key] ?? this.questions.find((one) => one.key === key)?.guess ?? "")) return;
        if (said) this.answers[key] = said;
        else delete this.answers[key];
        this.last = this.changed();
      };
      made.addEventListener("change", take);
      // Drawn again while it was typed in, a field tells no change.
      made.addEventListener("blur", take);
    }
    if (!(key in this.sent) && made !== document.activeElement) made.value = guess ?? "";
    if (bare) made.setAttribute("aria-label", text);
    return bare ? withMistake(made, wrong.get(key)) : withMistake(labelled(text, made), wrong.get(key), made);
  }

  /** Look again after a change; what is wrong with it is said beside its field. */
  async changed() {
    try {
      await this.update();
    } catch (error) {
      this.asks.append(warning(/** @type {Error} */ (error).message));
    }
  }

  /** @param {Event} event */
  async write(event) {
    event.preventDefault();
    // What that look brings up would take the place of what is missing.
    await this.last;
    // What has just been typed counts, though its field was not left.
    for (const [key, field] of this.fields) {
      const guess = this.questions.find((one) => one.key === key)?.guess;
      if (field.isConnected && field.value.trim() && field.value !== guess) this.answers[key] = field.value;
    }
    try {
      const made = await send("POST", "drafted", { folder: this.folder(), ...this.said() });
      say(`Wrote ${made.name}/campaign.toml.`);
      location.hash = campaignAddress(made.name);
    } catch (error) {
      const lines = error instanceof Refused ? error.told.problems : null;
      if (lines) this.show(this.told, lines);
      else this.asks.append(warning(/** @type {Error} */ (error).message));
    }
  }
}

/**
 * A field with what is wrong with its answer.
 * @param {HTMLElement} element
 * @param {string|undefined} mistake
 * @param {HTMLElement} control
 */
function withMistake(element, mistake, control = element) {
  if (mistake) control.setAttribute("aria-invalid", "true");
  else control.removeAttribute("aria-invalid");
  return mistake ? make("div", {}, element, make("p", { class: "wrong", role: "alert" }, mistake)) : element;
}

/** @type {(name: string, attributes: Record<string, string|number>, ...children: Node[]) => SVGElement} */
const draw = (name, attributes, ...children) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  element.append(...children);
  return element;
};

/**
 * The tip of an arrow on a circle about 0.
 * @param {number} degrees from up, clockwise
 * @param {number} radius
 */
export const tipOf = (degrees, radius) => {
  const angle = degrees * Math.PI / 180;
  return [Number((radius * Math.sin(angle)).toFixed(2)), Number((-radius * Math.cos(angle)).toFixed(2))];
};

/**
 * Where the input axis points at each position, as arrows on a circle.
 * @param {number[]} directions from up, clockwise, deg
 */
function circleOf(directions) {
  const label = `The input axis at ${directions.length} positions, seen from the south, in degrees from up by east: ` +
    directions.map((one) => Number(one.toFixed(1))).join(", ");
  const arrows = directions.map((one) => {
    const [x, y] = tipOf(one, 80);
    return draw("g", {}, draw("path", { d: `M0 0L${x} ${y}` }), draw("circle", { cx: x, cy: y, r: 4 }));
  });
  const words = [["up", 0, "middle"], ["east", 90, "start"], ["down", 180, "middle"], ["west", 270, "end"]].map(([word, angle, anchor]) => {
    const [x, y] = tipOf(Number(angle), anchor === "middle" ? 98 : 90);
    return draw("text", { x, y: y + 4, "text-anchor": anchor }, document.createTextNode(String(word)));
  });
  return make("figure", {}, make("figcaption", {}, "The input axis at each position, seen from the south"),
    draw("svg", { viewBox: "-130 -112 260 224", class: "circle", role: "img", "aria-label": label },
      draw("circle", { cx: 0, cy: 0, r: 80, class: "rim" }), ...arrows, ...words));
}

/**
 * A small drawing of a column.
 * @param {string} name
 * @param {([number, number]|null)[]} extent least and greatest value of each part
 */
function picture(name, extent) {
  const known = extent.flatMap((part) => part ?? []);
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const height = (/** @type {number} */ value) => 30 - 28 * (high > low ? (value - low) / (high - low) : 0.5);
  const d = extent.map((part, place) =>
    part ? `M${place} ${height(part[0]) + 0.5}L${place} ${height(part[1]) - 0.5}` : "").join("");
  return draw("svg", { viewBox: `0 0 ${extent.length} 32`, role: "img", preserveAspectRatio: "none",
    "aria-label": `${name}, from ${low.toPrecision(4)} to ${high.toPrecision(4)}` }, draw("path", { d }));
}
