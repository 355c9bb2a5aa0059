// @ts-check
// Confirmation of the detected contents of files, and questions that the files do not answer.

import { campaignAddress } from "./addresses.js";
import { RequestError, send } from "./api.js";
import { attempt, labelled, make, say, warning, working } from "./dom.js";
import { machineDrawing } from "./drawings.js";
import { directionCircle, curveFigure } from "./curves.js";
import { quantityField } from "./quantity.js";
import { forgetImport, keepImport } from "./unfinished.js";

/** @typedef {import("./quantity.js").Question} Question */
/** @typedef {import("./quantity.js").Field} Field */

/**
 * Test type -> roles of a single column, roles of several columns, and label of a column without a role.
 */
const ROLES = {
  "double-turntable": { parts: ["time", "angle"], others: ["displacement", "velocity", "specific_force", "unused"], blank: "choose" },
  "tumble": { parts: ["position"], others: ["reading", "uncertainty", "temperature", "time", "unused"], blank: "choose" },
  "arm": { parts: ["rate", "position"], others: ["radius", "reading", "uncertainty", "temperature", "time", "unused"], blank: "choose" },
  "poses": { parts: ["time", "X", "Y", "Z"], others: [], blank: "unused" },
};
/** Test type -> its label. */
const TESTS = {
  "double-turntable": "Double-turntable records",
  "tumble": "Tumble-test readings",
  "arm": "Arm-centrifuge readings",
  "poses": "Sensor records in many poses",
};
/** Question -> label; the text of the question is the help. */
const LABELS = /** @type {Record<string, string>} */ ({
  gravity: "Local gravity",
  latitude: "Latitude",
  radius: "Radius",
  sense: "Sense of rotation",
});
const NO_COLUMN = "none";
/** Largest number of checks after a change, while earlier answers become relevant. */
const MAX_CHECKS = 4;

/**
 * The answers to these questions; answers for other test types are kept.
 * @param {Question[]} questions
 * @param {Record<string, string>} answers by the keys of questions
 */
export const relevantAnswers = (questions, answers) => Object.fromEntries(questions
  .filter(({ key, choices }) => key in answers && (!choices.length || choices.includes(answers[key])))
  .map(({ key }) => [key, answers[key]]));

/**
 * Repeat a check until all answers have been sent: an answer may lead to a question with an earlier answer.
 * @template T
 * @param {() => Promise<T|null>} check sends the answers; null: a later look has begun meanwhile
 * @param {() => string[]} answeredKeys the questions known so far that are answered
 * @returns {Promise<T|null>} the last look's answer
 */
export async function checkUntilSettled(check, answeredKeys) {
  for (let count = 1; ; count++) {
    const sentKeys = answeredKeys();
    const answer = await check();
    if (answer === null || count === MAX_CHECKS || answeredKeys().every((key) => sentKeys.includes(key))) return answer;
  }
}

/** The contents of files, with a field for every answer. */
export class Confirmation {
  /**
   * @param {HTMLElement} container
   * @param {import("./unfinished.js").Unfinished} status files and folder; answers, also to another test type
   * @param {string[]|null} tests test types that are possible, the first one by default; null: any
   */
  constructor(container, status, tests) {
    this.container = container;
    this.importState = status;
    this.names = status.names;
    this.folder = status.folder;
    this.tests = tests;
    /** Test type; empty: to be guessed. */
    this.test = status.test;
    /** @type {Record<string, string>} a person's answers, by the keys of questions */
    this.answers = status.answers;
    /** @type {Record<string, string>} those of them that this test type asks for */
    this.sentAnswers = {};
    /** @type {Question[]} of this test type, as far as they are known */
    this.questions = [];
    /** @type {Map<string, Field>} kept, so that nothing typed is lost */
    this.fields = new Map();
    this.checkNumber = 0;
    /** @type {Set<string>} keys whose answer was remembered from another campaign */
    this.remembered = new Set();
    /** @type {import("./answers.js").DraftOverview | null} the server's last answer about the files */
    this.draft = null;
    /** @type {Promise<void>} the last look after a change */
    this.pending = Promise.resolve();
    this.questionArea = make("div");
    this.columnArea = make("div");
    this.detailArea = make("div");
    this.checklist = make("ul", { class: "checklist" });
    this.status = make("p", { class: "quiet", role: "status" });
    this.testSelect = make("select", { onchange: () => this.chooseTest() },
      make("option", { value: "" }, "Detect from the files"),
      ...Object.entries(TESTS).map(([value, label]) => make("option", { value }, label)));
    // The buttons stay in place while the files are checked again.
    this.form = make("form", {
      class: "confirm", novalidate: true,
      onsubmit: (/** @type {Event} */ event) => {
        event.preventDefault();
        this.write(true);
      },
    },
    make("div", {}, this.questionArea, this.columnArea, this.detailArea),
    make("aside", { class: "panel" }, make("h2", {}, "Checklist"), labelled("Test type", this.testSelect), this.checklist,
      make("button", { class: "main" }, "Calibrate"),
      make("button", { type: "button", onclick: () => this.write(false) }, "Save without calibrating"), this.status));
  }

  /** The files and the answers so far. */
  request() {
    this.sentAnswers = relevantAnswers(this.questions, this.answers);
    this.store();
    return { names: this.names, answers: this.sentAnswers, test: this.test || null };
  }

  /** Store the answers and stop, because another confirmation replaces this one. */
  end() {
    this.checkNumber++;
    this.takeFields();
    this.store();
  }

  /** Keep the files and the answers for a reload. */
  store() {
    keepImport({ ...this.importState, test: this.test, answers: this.answers });
  }

  /** Store the text of each field, including the field with the focus. */
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

  /** Check the files again for another test type. */
  chooseTest() {
    this.test = this.testSelect.value;
    this.pending = this.recheck();
  }

  /** Check the files with the current answers, and show the draft. */
  async update() {
    const number = ++this.checkNumber;
    const draft = await checkUntilSettled(async () => {
      let draft = await send("POST", "draft", this.request());
      if (number !== this.checkNumber) return null;
      if (this.tests && !this.tests.includes(draft.test ?? "")) {
        this.test = this.tests[0];
        draft = await send("POST", "draft", this.request());
        if (number !== this.checkNumber) return null;
      }
      this.tests = null;
      this.test = draft.test ?? "";
      this.questions = draft.questions;
      this.applyRemembered(draft.remembered);
      return draft;
    }, () => Object.keys(relevantAnswers(this.questions, this.answers)));
    if (draft === null) return;
    this.request();
    this.show(draft, draft.problems);
  }

  /**
   * Copy answers from the last campaign, once.
   * @param {Record<string, {answer: string, campaign: string}>} remembered
   */
  applyRemembered(remembered) {
    for (const [key, { answer }] of Object.entries(remembered)) {
      if (this.remembered.has(key) || !this.questions.some((question) => question.key === key)) continue;
      this.remembered.add(key);
      this.answers[key] ??= answer;
    }
  }

  /**
   * @param {import("./answers.js").DraftOverview} draft
   * @param {string[]} problems a line each, which begins with the key of a question
   */
  show(draft, problems) {
    /** @type {Map<string, Question>} */
    const questions = new Map(this.questions.map((question) => [question.key, question]));
    const mistakes = new Map(problems.map((line) => {
      const key = [...questions.keys()].find((knownKey) => line.startsWith(`${knownKey}: `)) ?? "";
      const isOpen = key && !(key in this.sentAnswers);
      return [key, isOpen ? `Required, for example ${questions.get(key)?.example}.` : line.slice(key ? key.length + 2 : 0)];
    }));
    const focused = /** @type {HTMLElement} */ (document.activeElement);
    this.draft = draft;
    this.testSelect.value = this.test;
    const { element, keys } = this.columnCards(draft, questions, mistakes);
    const shownKeys = new Set(keys);
    const otherQuestions = this.questions.filter(({ key }) => !shownKeys.has(key) && !key.endsWith(" is"));
    const siteQuestions = otherQuestions.filter(({ key }) => key in LABELS), furtherQuestions = otherQuestions.filter(({ key }) => !(key in LABELS));
    this.questionArea.replaceChildren(
      make("h2", {}, "Information not contained in the files"),
      make("div", { class: "site" }, ...siteQuestions.map((question) => this.field(question, mistakes))),
      make("div", { class: "site" }, ...furtherQuestions.map((question) => this.field(question, mistakes))),
      ...(mistakes.has("") ? [warning(/** @type {string} */ (mistakes.get("")))] : []));
    this.columnArea.replaceChildren(element);
    this.detailArea.replaceChildren(
      make("div", { class: "figures" }, ...(draft.directions.length ? [directionCircle(draft.directions)] : []),
        ...(this.test ? [machineDrawing(this.test === "poses" ? "accelerometer" : this.test, true)] : [])),
      make("details", {}, make("summary", {}, "Properties detected in the files"),
        make("ul", {}, ...draft.statements.map((/** @type {string} */ line) => make("li", {}, line)))));
    this.showChecklist(draft);
    if (!this.form.isConnected) this.container.replaceChildren(this.form);
    if (focused?.isConnected) focused.focus();
  }

  /** Questions without an answer or a guess. */
  openQuestions() {
    return this.questions.filter(({ key, guess }) => guess === null && !(key in this.sentAnswers));
  }

  /** @param {import("./answers.js").DraftOverview} draft */
  showChecklist(draft) {
    const openKeys = new Set(this.openQuestions().map(({ key }) => key));
    const item = (/** @type {string} */ state, /** @type {string} */ label, /** @type {string} */ remark, /** @type {string} */ key = "") =>
      make("li", { class: state }, key
        ? make("button", { type: "button", class: "link", onclick: () => this.fields.get(key)?.control.focus() }, label)
        : make("span", {}, label), make("span", { class: "quiet" }, remark));
    const usedCount = draft.columns.length - this.unusedColumns(draft).length;
    this.checklist.replaceChildren(
      item("done", "Columns", `${usedCount} used, ${draft.columns.length - usedCount} unused`),
      ...this.questions.filter(({ key, guess }) => (guess === null || key in LABELS) && !key.endsWith(" is")).map(({ key, text }) =>
        item(openKeys.has(key) ? "open" : "done", LABELS[key] ?? text, openKeys.has(key) ? "open"
          : this.remembered.has(key) && this.sentAnswers[key] === draft.remembered[key]?.answer
            ? `copied from ${draft.remembered[key].campaign}; please check` : "", key)),
      item("optional", "Bias and scale factor", "optional, in the description"),
      item("optional", "Serial number and date", "optional, for history and certificate"));
    const names = this.openQuestions().map(({ key, text }) => LABELS[key] ?? text);
    this.status.textContent = names.length ? `${names.length} ${names.length > 1 ? "answers are" : "answer is"} missing: ${names.join(", ")}` : "";
  }

  /**
   * The role of a column; empty if unknown.
   * @param {import("./answers.js").ColumnEntry} column
   * @returns {string}
   */
  roleOf({ name }) {
    const answerOf = (/** @type {string} */ key) => this.sentAnswers[key] ?? this.questions.find((question) => question.key === key)?.guess;
    return this.roles().parts.find((role) => answerOf(role) === name) ?? answerOf(`${name} is`) ?? "";
  }

  /**
   * The answered or detected unit of a column without a unit in the file; for the axes of a sensor, their common unit.
   * @param {string} key of the question
   * @returns {string}
   */
  unitOf(key) {
    const question = [key, "unit"].map((candidate) => this.questions.find((known) => known.key === candidate)).find(Boolean);
    const unit = question ? this.sentAnswers[question.key] ?? question.guess ?? "" : "";
    return unit === "iso" ? "" : unit;
  }

  /** @param {import("./answers.js").DraftOverview} draft */
  unusedColumns(draft) {
    const askedKeys = new Set(this.questions.map(({ key }) => key));
    return draft.columns.filter((column) => {
      const role = this.roleOf(column);
      // A text column can have a role only if there is a question for it.
      const isUnusedByDefault = this.roles().blank === "unused" || (column.curve === null && !askedKeys.has(`${column.name} is`));
      return role === "unused" || (!role && isUnusedByDefault);
    });
  }

  /**
   * The used columns as cards, and the unused columns in a table with reasons.
   * @param {import("./answers.js").DraftOverview} draft
   * @param {Map<string, Question>} questions
   * @param {Map<string, string>} mistakes
   */
  columnCards(draft, questions, mistakes) {
    const { parts: singleRoles } = this.roles();
    /** @type {string[]} */
    const keys = [...singleRoles];
    const unused = this.unusedColumns(draft);
    const cards = draft.columns.filter((column) => !unused.includes(column)).map((column) => {
      const { name, curve, first: firstValues } = column, role = this.roleOf(column);
      const isSingleRole = singleRoles.includes(role);
      const unitKey = isSingleRole ? `${role} unit` : `${name} unit`;
      const [unit, axis] = [unitKey, isSingleRole ? "" : `${name} axis`].map((key) => {
        const question = questions.get(key);
        if (!question) return null;
        keys.push(key);
        return this.field(question, mistakes, true);
      });
      return make("li", { class: "panel column" },
        make("div", { class: "row" }, make("code", {}, name), axis),
        make("div", { class: "row" }, this.role(column, role, questions, mistakes), unit),
        curve ? curveFigure(name, { ...curve, unit: curve.unit || this.unitOf(unitKey) }) : null,
        make("p", { class: "quiet first" }, `${firstValues.filter(Boolean).slice(0, 3).join(", ") || "empty"}${firstValues.length ? " …" : ""}`));
    });
    const fileCount = this.names.length > 1 ? `, ${this.names.length} files` : "";
    const element = make("div", {}, make("h2", {}, `Columns in ${draft.file}${fileCount}`),
      make("ul", { class: "columns" }, ...cards),
      unused.length ? make("details", { class: "unused", open: true }, make("summary", {}, `Unused columns (${unused.length})`),
        make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Unused columns" }, make("table", {},
          make("thead", {}, make("tr", {}, ...["Column", "Reason", "First values", "Use as"].map((heading) => make("th", { scope: "col" }, heading)))),
          make("tbody", {}, ...unused.map((column) => make("tr", {},
            make("th", { scope: "row" }, make("code", {}, column.name)), make("td", {}, column.reason),
            make("td", {}, column.first.filter(Boolean).slice(0, 3).join(", ") || "empty"),
            make("td", {}, column.curve || questions.has(`${column.name} is`)
              ? this.role(column, this.roleOf(column), questions, mistakes) : "")))))))
        : null);
    return { element, keys };
  }

  /**
   * Return the select control for the role of a column.
   * @param {import("./answers.js").ColumnEntry} column
   * @param {string} role
   * @param {Map<string, Question>} questions
   * @param {Map<string, string>} mistakes
   */
  role(column, role, questions, mistakes) {
    const { name } = column;
    const { parts: singleRoles, others: otherRoles, blank: blankLabel } = this.roles();
    const choices = [...new Set([...singleRoles, ...questions.get(`${name} is`)?.choices ?? otherRoles])];
    const control = make("select", {
      "aria-label": `Role of column ${name}`,
      onchange: () => {
        for (const singleRole of singleRoles) {
          if (control.value === singleRole) this.answers[singleRole] = name;
          else if (singleRole === role) {
            if (questions.get(singleRole)?.choices.includes(NO_COLUMN)) this.answers[singleRole] = NO_COLUMN;
            else delete this.answers[singleRole];
          }
        }
        delete this.answers[`${name} is`];
        if (control.value && !singleRoles.includes(control.value)) this.answers[`${name} is`] = control.value;
        this.pending = this.recheck();
      },
    }, ...(role ? [] : [""]).concat(choices).map((value) =>
      make("option", { value }, value.replace("_", " ") || blankLabel)));
    control.value = role;
    const mistake = mistakes.get(`${name} is`);
    if (mistake) control.setAttribute("aria-invalid", "true");
    return mistake ? make("div", {}, control, make("p", { class: "wrong", role: "alert" }, mistake)) : control;
  }

  /**
   * Return the input field of a question.
   * @param {Question} question
   * @param {Map<string, string>} mistakes
   * @param {boolean} isBare whether the label is omitted
   */
  field(question, mistakes, isBare = false) {
    const { key, guess } = question;
    const label = LABELS[key];
    let field = this.fields.get(key);
    if (!field) {
      field = quantityField(question, label ?? question.text, label && !question.text.startsWith(`What is the ${label.toLowerCase()}?`) ? question.text : "", isBare, () => this.takeAnswer(key));
      this.fields.set(key, field);
      field.write(this.sentAnswers[key] ?? "");
    }
    if (!field.active()) field.write(this.sentAnswers[key] ?? guess ?? "");
    field.judge(mistakes.get(key));
    return field.element;
  }

  /** @param {string} key of a field that was changed or left */
  takeAnswer(key) {
    const text = this.fields.get(key)?.read() ?? "";
    if (text === (this.answers[key] ?? this.questions.find((question) => question.key === key)?.guess ?? "")) return;
    if (text) this.answers[key] = text;
    else delete this.answers[key];
    this.pending = this.recheck();
  }

  /** Check the files again after a change. */
  async recheck() {
    const number = this.checkNumber + 1;
    try {
      await this.update();
    } catch (error) {
      if (number === this.checkNumber) this.status.replaceChildren(warning(/** @type {Error} */ (error).message));
    }
  }

  /** @param {boolean} calibrate whether a calibration follows */
  async write(calibrate) {
    this.status.replaceChildren(working("Writing the campaign"));
    // A second press would write the campaign again.
    const buttons = /** @type {NodeListOf<HTMLButtonElement>} */ (this.form.querySelectorAll(".panel > button"));
    buttons.forEach((button) => { button.disabled = true; });
    // A pending check would replace the fields that are marked below.
    await this.pending;
    this.takeFields();
    try {
      const { name } = await send("POST", "drafted", { folder: this.folder, ...this.request() });
      forgetImport();
      say(`Wrote the campaign ${name}.`);
      // If the calibration cannot start, the campaign's page states why.
      if (calibrate) await send("POST", "jobs", { name }).catch(() => {});
      if (this.form.isConnected) location.hash = campaignAddress(name);
    } catch (error) {
      buttons.forEach((button) => { button.disabled = false; });
      const lines = error instanceof RequestError ? error.body.problems : null;
      if (lines && this.draft) {
        this.show(this.draft, lines);
        /** @type {HTMLElement|null} */ (this.form.querySelector('[aria-invalid="true"]'))?.focus();
      } else {
        attempt(this.status, async () => { throw error; });
      }
    }
  }
}
