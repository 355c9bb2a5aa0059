// @ts-check
// The form of the laboratory data for a certificate.

import { send } from "./api.js";
import { make, say } from "./dom.js";
import { Editor, keyPath } from "./editor.js";

/** @typedef {import("./editor.js").Field} Field */
/** @typedef {import("./editor.js").Section} Section */
/** @typedef {import("./editor.js").Part} Part */

/** Sections in the order of the page: key -> title. */
const TITLES = /** @type {Record<string, string>} */ ({
  item: "Item",
  accelerometers: "Accelerometers",
  customer: "Customer",
  certificate: "Calibration",
  conditions: "Environmental conditions",
  evidence: "Evidence",
  laboratory: "Laboratory",
  persons: "Responsible persons",
  equipment: "Equipment",
  specification: "Specification",
  file: "Entries as text",
});

/** @param {string} section */
export const titleOf = (section) => TITLES[section] ?? section;

/** Number of values in the summary of a section. */
const SUMMARY_VALUES = 3;

/** @param {string} key */
const sectionKey = (key) => key.replace(/[.[].*/, "");

/** @param {string} key */
const unquoted = (key) => key.replaceAll('"', "");

export class CertificateForm extends Editor {
  /**
   * @param {import("./answers.js").LaboratoryData} labData the laboratory data
   * @param {{result: string, shown: () => void}} options
   */
  constructor(labData, options) {
    const order = Object.keys(TITLES);
    super({ ...labData, form: labData.form.toSorted((/** @type {Section} */ first, /** @type {Section} */ second) =>
      order.indexOf(first.key) - order.indexOf(second.key)) }, options);
    /** @type {boolean} */ this.hasProfile = labData.profile;
  }

  /**
   * Whether a certificate needs an entry that is missing, or has the value of the template.
   * @param {Part[]} path
   */
  lacks(path) {
    const key = unquoted(keyPath(path));
    return this.content.missing.some((entry) => unquoted(entry.key) === key);
  }

  /** @param {Section} section */
  section(section) {
    const { key } = section;
    const fields = key === "evidence" ? this.evidenceFields(section.fields) : section.fields;
    const details = super.section({ ...section, fields });
    details.open = this.content.missing.some((entry) => sectionKey(entry.key) === key);
    details.querySelector("summary")?.replaceChildren(titleOf(key),
      make("span", { class: "quiet" }, this.contentOf(key)));
    if (key === "laboratory") details.append(this.profileRow());
    return details;
  }

  /**
   * Fields of [evidence]; required fields have the reason as help.
   * @param {Field[]} fields
   */
  evidenceFields(fields) {
    const needed = this.content.missing.filter(({ key }) => key.startsWith("evidence."));
    const names = needed.map(({ key }) => key.slice("evidence.".length));
    const makeField = (/** @type {string} */ key, /** @type {string} */ help) => ({
      key, label: fields.find((field) => field.key === key)?.label ?? key, help, links: [], kind: "text", required: false, example: "Type test TR-12",
    });
    return [...needed.map(({ words: reason }, index) => makeField(names[index], reason)),
      ...Object.keys(this.content.document.evidence ?? {})
        .filter((key) => !names.includes(key) && fields.every((field) => field.key !== key))
        .map((key) => makeField(key, "")),
      ...fields.filter(({ key }) => !names.includes(key))
        .map((field) => (field.key === "all" ? { ...field, visible: needed.length > 1 } : field))];
  }

  /**
   * The first values of a section, for its summary.
   * @param {string} key
   */
  contentOf(key) {
    const value = this.content.document[key];
    const table = Array.isArray(value) ? value[0] : value;
    const path = Array.isArray(value) ? [key, 0] : [key];
    return Object.entries(table ?? {})
      .filter(([name, text]) => typeof text === "string" && !this.lacks([...path, name]))
      .slice(0, SUMMARY_VALUES).map(([, text]) => text).join(", ");
  }

  profileRow() {
    return make("div", { class: "row" }, this.profileButton(), make("p", { class: "help" },
      "The laboratory profile provides the laboratory, personnel and traceability entries of the next certificate."));
  }

  profileButton() {
    return make("button", {
      type: "button",
      onclick: () => this.saveProfile().catch((error) => say(error.message)),
    }, "Save laboratory profile");
  }

  async saveProfile() {
    await this.pending;
    const { file } = await send("POST", "profile", { file: this.file, text: this.content.text });
    this.hasProfile = true;
    say(`Saved the laboratory profile as ${file}.`);
  }

  /** Mark fields with mistakes; `gaps` lists them. */
  showProblems() {
    super.showProblems();
    this.messages.firstElementChild?.remove();
  }

  /**
   * @param {Field[]} fields
   * @param {Part[]} path
   * @param {any} value
   */
  group(fields, path, value) {
    return super.group(fields.map((field) =>
      (this.lacks([...path, field.key]) ? { ...field, required: true } : field)), path, value);
  }

  /**
   * A field, empty where it has the value of the template.
   * @param {Field} field
   * @param {Part[]} path
   * @param {any} value
   */
  field(field, path, value) {
    const container = super.field(field, path, this.lacks(path) ? undefined : value);
    if (field.required) {
      container.querySelector("label")?.firstChild?.after(make("span", { class: "required", "aria-hidden": "true" }, " *"));
    }
    return container;
  }

  /**
   * @param {string} key
   * @returns {HTMLElement | undefined}
   */
  containerOf(key) {
    for (let name = unquoted(key); name; name = name.replace(/(^|\.)[^.]*$/, "")) {
      const entry = [...this.containers ?? []].find(([path]) => unquoted(path) === name);
      if (entry) return entry[1];
    }
    return undefined;
  }

  /** Entries that prevent the issue of a certificate, in the order of the form. */
  gaps() {
    const gaps = [
      ...this.content.missing.map(({ key, words: message }) => ({
        key, words: key.startsWith("evidence.") ? message.replace(/^is missing; /, "") : "",
      })),
      ...this.content.problems.map(({ key, words: message }) => ({ key, words: message })),
    ].map(({ key, words: message }) => ({
      place: this.form.findIndex((section) => section.key === sectionKey(key)),
      section: titleOf(sectionKey(key)),
      text: this.labelOf(key),
      words: message,
      go: () => this.focus(key),
      leaveOut: this.canLeaveOut(key) ? () => this.leaveOut(key) : null,
    }));
    return gaps.sort((first, second) => first.place - second.place);
  }

  /** @param {string} key */
  labelOf(key) {
    const label = this.containerOf(key)?.querySelector(":scope > label")?.firstChild?.textContent;
    return label || key || "the text";
  }

  /** @param {string} key */
  focus(key) {
    const container = this.containerOf(key);
    for (let details = container?.closest("details"); details; details = details.parentElement?.closest("details")) details.open = true;
    const control = /** @type {HTMLElement | null | undefined} */ (container?.querySelector("input, select, textarea"));
    control?.scrollIntoView({ block: "center" });
    control?.focus({ preventScroll: true });
  }

  /**
   * Whether an entry with the value of the template may be removed instead.
   * @param {string} key
   */
  canLeaveOut(key) {
    const [section, name] = key.split(".");
    const field = this.form.find((candidate) => candidate.key === section)?.fields.find((candidate) => candidate.key === name);
    return Boolean(field && !field.required && this.content.document[section]?.[name] !== undefined);
  }

  /** @param {string} key */
  leaveOut(key) {
    return this.change(key.split("."), null);
  }
}
