// @ts-check
// Confirm: the contents found in files, as cards that may be changed, and the questions that no file answers.

import { campaignAddress } from "./addresses.js";
import { Refused, send } from "./api.js";
import { attempt, labelled, make, say, warning, working } from "./dom.js";
import { drawingOf } from "./drawings.js";
import { circleOf, curveOf } from "./curves.js";
import { quantityField } from "./quantity.js";
import { forgetImport, keepImport } from "./unfinished.js";

/** @typedef {import("./quantity.js").Question} Question */
/** @typedef {import("./quantity.js").Field} Field */

/**
 * Test type -> roles of a single column, roles of any column, and words of a column without a role.
 */
const ROLES = {
  "double-turntable": { parts: ["time", "angle"], others: ["displacement", "velocity", "specific_force", "unused"], blank: "choose" },
  "tumble": { parts: ["position"], others: ["reading", "uncertainty", "temperature", "time", "unused"], blank: "choose" },
  "arm": { parts: ["rate", "position"], others: ["radius", "reading", "uncertainty", "temperature", "time", "unused"], blank: "choose" },
  "poses": { parts: ["time", "X", "Y", "Z"], others: [], blank: "unused" },
};
/** Test type -> its words. */
const TESTS = {
  "double-turntable": "Double-turntable records",
  "tumble": "Tumble-test readings",
  "arm": "Arm-centrifuge readings",
  "poses": "Sensor records in many poses",
};
/** Question -> label; the question itself is then the help. */
const LABELS = /** @type {Record<string, string>} */ ({
  gravity: "Local gravity",
  latitude: "Latitude",
  radius: "Radius",
  sense: "Sense of rotation",
});
const NONE = "none";
/** How often the files are judged again after a change, while that brings up earlier answers. */
const MOST_LOOKS = 4;

/**
 * The answers to these questions; an answer to another kind of test is kept for when it is chosen again.
 * @param {Question[]} questions
 * @param {Record<string, string>} answers by the keys of questions
 */
export const answersTo = (questions, answers) => Object.fromEntries(questions
  .filter(({ key, choices }) => key in answers && (!choices.length || choices.includes(answers[key])))
  .map(({ key }) => [key, answers[key]]));

/**
 * Look until no answer is left unsent, or often enough: an answer may lead to a question that is answered already.
 * @template T
 * @param {() => Promise<T|null>} look sends the answers; null: a later look has begun meanwhile
 * @param {() => string[]} answered the questions known so far that are answered
 * @returns {Promise<T|null>} the last look's answer
 */
export async function lookUntilSettled(look, answered) {
  for (let count = 1; ; count++) {
    const sent = answered();
    const answer = await look();
    if (answer === null || count === MOST_LOOKS || answered().every((key) => sent.includes(key))) return answer;
  }
}

/** The contents of files, with a field for every answer. */
export class Confirmation {
  /**
   * @param {HTMLElement} place
   * @param {import("./unfinished.js").Unfinished} state files and folder; answers, also to another kind of test
   * @param {string[]|null} tests kinds of test that are possible, the first one by default; null: any
   */
  constructor(place, state, tests) {
    this.place = place;
    this.unfinished = state;
    this.names = state.names;
    this.folder = state.folder;
    this.tests = tests;
    /** Test type; empty: to be guessed. */
    this.test = state.test;
    /** @type {Record<string, string>} a person's answers, by the keys of questions */
    this.answers = state.answers;
    /** @type {Record<string, string>} those of them that this kind of test asks for */
    this.sent = {};
    /** @type {Question[]} of this kind of test, as far as they are known */
    this.questions = [];
    /** @type {Map<string, Field>} kept, so that nothing typed is lost */
    this.fields = new Map();
    this.looks = 0;
    /** @type {Set<string>} keys whose answer was remembered from another campaign */
    this.remembered = new Set();
    /** @type {import("./answers.js").DraftOverview | null} the server's last answer about the files */
    this.found = null;
    /** @type {Promise<void>} the last look after a change */
    this.last = Promise.resolve();
    this.asks = make("div");
    this.columns = make("div");
    this.below = make("div");
    this.list = make("ul", { class: "checklist" });
    this.state = make("p", { class: "quiet", role: "status" });
    this.kindOfTest = make("select", { onchange: () => this.chooseTest() },
      make("option", { value: "" }, "Detect from the files"),
      ...Object.entries(TESTS).map(([value, words]) => make("option", { value }, words)));
    // The buttons stay where they are while the files are judged again.
    this.form = make("form", {
      class: "confirm", novalidate: true,
      onsubmit: (/** @type {Event} */ event) => {
        event.preventDefault();
        this.write(true);
      },
    },
    make("div", {}, this.asks, this.columns, this.below),
    make("aside", { class: "panel" }, make("h2", {}, "Checklist"), labelled("Test type", this.kindOfTest), this.list,
      make("button", { class: "main" }, "Calibrate"),
      make("button", { type: "button", onclick: () => this.write(false) }, "Save without calibrating"), this.state));
  }

  /** The files and the answers so far. */
  request() {
    this.sent = answersTo(this.questions, this.answers);
    this.keep();
    return { names: this.names, answers: this.sent, test: this.test || null };
  }

  /** Keep the answers, and show nothing more, because another confirmation takes the place. */
  end() {
    this.looks++;
    this.takeFields();
    this.keep();
  }

  /** Keep the files and the answers for a reload. */
  keep() {
    keepImport({ ...this.unfinished, test: this.test, answers: this.answers });
  }

  /** Take up the text of each field; the field that is typed in counts, too. */
  takeFields() {
    for (const [key, field] of this.fields) {
      const guess = this.questions.find((question) => question.key === key)?.guess;
      const text = field.read();
      if (field.element.isConnected && text && text !== guess) this.answers[key] = text;
    }
  }

  /** Roles of the columns. */
  roles() {
    return ROLES[/** @type {keyof typeof ROLES} */ (this.test)] ?? { parts: [], others: [], blank: "choose" };
  }

  /** Judge the files again as another kind of test. */
  chooseTest() {
    this.test = this.kindOfTest.value;
    this.last = this.changed();
  }

  /** Have the files judged with the answers so far, and show it. */
  async update() {
    const mine = ++this.looks;
    const found = await lookUntilSettled(async () => {
      let look = await send("POST", "draft", this.request());
      if (mine !== this.looks) return null;
      if (this.tests && !this.tests.includes(look.test ?? "")) {
        this.test = this.tests[0];
        look = await send("POST", "draft", this.request());
        if (mine !== this.looks) return null;
      }
      this.tests = null;
      this.test = look.test ?? "";
      this.questions = look.questions;
      this.recall(look.remembered);
      return look;
    }, () => Object.keys(answersTo(this.questions, this.answers)));
    if (found === null) return;
    this.request();
    this.show(found, found.problems);
  }

  /**
   * Answer questions as in the last campaign, once.
   * @param {Record<string, {answer: string, campaign: string}>} remembered
   */
  recall(remembered) {
    for (const [key, { answer }] of Object.entries(remembered)) {
      if (this.remembered.has(key) || !this.questions.some((question) => question.key === key)) continue;
      this.remembered.add(key);
      this.answers[key] ??= answer;
    }
  }

  /**
   * @param {import("./answers.js").DraftOverview} found
   * @param {string[]} problems a line each, which begins with the key of a question
   */
  show(found, problems) {
    /** @type {Map<string, Question>} */
    const questions = new Map(this.questions.map((question) => [question.key, question]));
    const wrong = new Map(problems.map((line) => {
      const key = [...questions.keys()].find((known) => line.startsWith(`${known}: `)) ?? "";
      const open = key && !(key in this.sent);
      return [key, open ? `Required, for example ${questions.get(key)?.example}.` : line.slice(key ? key.length + 2 : 0)];
    }));
    const active = /** @type {HTMLElement} */ (document.activeElement);
    this.found = found;
    this.kindOfTest.value = this.test;
    const { element, keys } = this.columnCards(found, questions, wrong);
    const shown = new Set(keys);
    const others = this.questions.filter(({ key }) => !shown.has(key) && !key.endsWith(" is"));
    const site = others.filter(({ key }) => key in LABELS), rest = others.filter(({ key }) => !(key in LABELS));
    this.asks.replaceChildren(
      make("h2", {}, "Information not contained in the files"),
      make("div", { class: "site" }, ...site.map((question) => this.field(question, wrong))),
      make("div", { class: "site" }, ...rest.map((question) => this.field(question, wrong))),
      ...(wrong.has("") ? [warning(/** @type {string} */ (wrong.get("")))] : []));
    this.columns.replaceChildren(element);
    this.below.replaceChildren(
      make("div", { class: "figures" }, ...(found.directions.length ? [circleOf(found.directions)] : []),
        ...(this.test ? [drawingOf(this.test === "poses" ? "accelerometer" : this.test, true)] : [])),
      make("details", {}, make("summary", {}, "Properties detected in the files"),
        make("ul", {}, ...found.statements.map((/** @type {string} */ line) => make("li", {}, line)))));
    this.showChecklist(found);
    if (!this.form.isConnected) this.place.replaceChildren(this.form);
    if (active?.isConnected) active.focus();
  }

  /** Questions that are neither answered nor guessed. */
  open() {
    return this.questions.filter(({ key, guess }) => guess === null && !(key in this.sent));
  }

  /** @param {import("./answers.js").DraftOverview} found */
  showChecklist(found) {
    const open = new Set(this.open().map(({ key }) => key));
    const item = (/** @type {string} */ state, /** @type {string} */ words, /** @type {string} */ more, /** @type {string} */ key = "") =>
      make("li", { class: state }, key
        ? make("button", { type: "button", class: "link", onclick: () => this.fields.get(key)?.control.focus() }, words)
        : make("span", {}, words), make("span", { class: "quiet" }, more));
    const used = found.columns.length - this.unused(found).length;
    this.list.replaceChildren(
      item("done", "Columns", `${used} used, ${found.columns.length - used} unused`),
      ...this.questions.filter(({ key, guess }) => (guess === null || key in LABELS) && !key.endsWith(" is")).map(({ key, text }) =>
        item(open.has(key) ? "open" : "done", LABELS[key] ?? text, open.has(key) ? "open"
          : this.remembered.has(key) && this.sent[key] === found.remembered[key]?.answer
            ? `copied from ${found.remembered[key].campaign}; please check` : "", key)),
      item("optional", "Bias and scale factor", "optional, in the description"),
      item("optional", "Serial number and date", "optional, for history and certificate"));
    const names = this.open().map(({ key, text }) => LABELS[key] ?? text);
    this.state.textContent = names.length ? `${names.length} ${names.length > 1 ? "answers are" : "answer is"} missing: ${names.join(", ")}` : "";
  }

  /**
   * The role of a column; empty where none is known.
   * @param {import("./answers.js").ColumnEntry} column
   * @returns {string}
   */
  roleOf({ name }) {
    const byKey = (/** @type {string} */ key) => this.sent[key] ?? this.questions.find((question) => question.key === key)?.guess;
    return this.roles().parts.find((part) => byKey(part) === name) ?? byKey(`${name} is`) ?? "";
  }

  /** @param {import("./answers.js").DraftOverview} found */
  unused(found) {
    const asked = new Set(this.questions.map(({ key }) => key));
    return found.columns.filter((column) => {
      const role = this.roleOf(column);
      // A column of text may have a role only where it is asked for.
      const without = this.roles().blank === "unused" || (column.curve === null && !asked.has(`${column.name} is`));
      return role === "unused" || (!role && without);
    });
  }

  /**
   * The columns in use as cards, and the others in a table with their reasons.
   * @param {import("./answers.js").DraftOverview} found
   * @param {Map<string, Question>} questions
   * @param {Map<string, string>} wrong
   */
  columnCards(found, questions, wrong) {
    const { parts } = this.roles();
    /** @type {string[]} */
    const keys = [...parts];
    const unused = this.unused(found);
    const cards = found.columns.filter((column) => !unused.includes(column)).map((column) => {
      const { name, curve, first } = column, role = this.roleOf(column);
      const part = parts.includes(role);
      const [unit, axis] = [part ? `${role} unit` : `${name} unit`, part ? "" : `${name} axis`].map((key) => {
        const question = questions.get(key);
        if (!question) return null;
        keys.push(key);
        return this.field(question, wrong, true);
      });
      return make("li", { class: "panel column" },
        make("div", { class: "row" }, make("code", {}, name), axis),
        make("div", { class: "row" }, this.role(column, role, questions, wrong), unit),
        curve ? curveOf(name, curve) : null,
        make("p", { class: "quiet first" }, `${first.filter(Boolean).slice(0, 3).join(", ") || "empty"}${first.length ? " …" : ""}`));
    });
    const names = this.names.length > 1 ? `, ${this.names.length} files` : "";
    const element = make("div", {}, make("h2", {}, `Columns in ${found.file}${names}`),
      make("ul", { class: "columns" }, ...cards),
      unused.length ? make("details", { class: "unused", open: true }, make("summary", {}, `Unused columns (${unused.length})`),
        make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Unused columns" }, make("table", {},
          make("thead", {}, make("tr", {}, ...["Column", "Reason", "First values", "Use as"].map((words) => make("th", { scope: "col" }, words)))),
          make("tbody", {}, ...unused.map((column) => make("tr", {},
            make("th", { scope: "row" }, make("code", {}, column.name)), make("td", {}, column.reason),
            make("td", {}, column.first.filter(Boolean).slice(0, 3).join(", ") || "empty"),
            make("td", {}, column.curve || questions.has(`${column.name} is`)
              ? this.role(column, this.roleOf(column), questions, wrong) : "")))))))
        : null);
    return { element, keys };
  }

  /**
   * The role of a column, as a choice.
   * @param {import("./answers.js").ColumnEntry} column
   * @param {string} role
   * @param {Map<string, Question>} questions
   * @param {Map<string, string>} wrong
   */
  role(column, role, questions, wrong) {
    const { name } = column;
    const { parts, others, blank } = this.roles();
    const choices = [...new Set([...parts, ...questions.get(`${name} is`)?.choices ?? others])];
    const control = make("select", {
      "aria-label": `Role of column ${name}`,
      onchange: () => {
        for (const part of parts) {
          if (control.value === part) this.answers[part] = name;
          else if (part === role) {
            if (questions.get(part)?.choices.includes(NONE)) this.answers[part] = NONE;
            else delete this.answers[part];
          }
        }
        delete this.answers[`${name} is`];
        if (control.value && !parts.includes(control.value)) this.answers[`${name} is`] = control.value;
        this.last = this.changed();
      },
    }, ...(role ? [] : [""]).concat(choices).map((value) =>
      make("option", { value }, value.replace("_", " ") || blank)));
    control.value = role;
    const mistake = wrong.get(`${name} is`);
    if (mistake) control.setAttribute("aria-invalid", "true");
    return mistake ? make("div", {}, control, make("p", { class: "wrong", role: "alert" }, mistake)) : control;
  }

  /**
   * The field of an answer.
   * @param {Question} question
   * @param {Map<string, string>} wrong
   * @param {boolean} bare without its label
   */
  field(question, wrong, bare = false) {
    const { key, guess } = question;
    const label = LABELS[key];
    let field = this.fields.get(key);
    if (!field) {
      field = quantityField(question, label ?? question.text, label && !question.text.startsWith(`What is the ${label.toLowerCase()}?`) ? question.text : "", bare, () => this.takeAnswer(key));
      this.fields.set(key, field);
      field.write(this.sent[key] ?? "");
    }
    if (!field.active()) field.write(this.sent[key] ?? guess ?? "");
    field.judge(wrong.get(key));
    return field.element;
  }

  /** @param {string} key of a field that was changed or left */
  takeAnswer(key) {
    const text = this.fields.get(key)?.read() ?? "";
    if (text === (this.answers[key] ?? this.questions.find((question) => question.key === key)?.guess ?? "")) return;
    if (text) this.answers[key] = text;
    else delete this.answers[key];
    this.last = this.changed();
  }

  /** Judge the files again after a change. */
  async changed() {
    const mine = this.looks + 1;
    try {
      await this.update();
    } catch (error) {
      if (mine === this.looks) this.state.replaceChildren(warning(/** @type {Error} */ (error).message));
    }
  }

  /** @param {boolean} calibrate whether a calibration follows */
  async write(calibrate) {
    this.state.replaceChildren(working("Writing the campaign"));
    // A second press would write the campaign again.
    const buttons = /** @type {NodeListOf<HTMLButtonElement>} */ (this.form.querySelectorAll(".panel > button"));
    buttons.forEach((button) => { button.disabled = true; });
    // The last look would replace the fields that are marked below.
    await this.last;
    this.takeFields();
    try {
      const { name } = await send("POST", "drafted", { folder: this.folder, ...this.request() });
      forgetImport();
      say(`Wrote the campaign ${name}.`);
      // A calibration that cannot begin says why on the campaign's page.
      if (calibrate) await send("POST", "jobs", { name }).catch(() => {});
      if (this.form.isConnected) location.hash = campaignAddress(name);
    } catch (error) {
      buttons.forEach((button) => { button.disabled = false; });
      const lines = error instanceof Refused ? error.told.problems : null;
      if (lines && this.found) {
        this.show(this.found, lines);
        /** @type {HTMLElement|null} */ (this.form.querySelector('[aria-invalid="true"]'))?.focus();
      } else {
        attempt(this.state, async () => { throw error; });
      }
    }
  }
}
