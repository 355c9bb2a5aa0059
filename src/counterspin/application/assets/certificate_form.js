// @ts-check
// The laboratory's data as a form with the entries that a certificate needs.

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

/** Values of a section that its summary shows. */
const SHOWN_VALUES = 3;

/** @param {string} key */
const sectionOf = (key) => key.replace(/[.[].*/, "");

/** @param {string} key */
const plain = (key) => key.replaceAll('"', "");

export class CertificateForm extends Editor {
  /**
   * @param {import("./answers.js").LaboratoryData} told the laboratory data
   * @param {{result: string, shown: () => void}} more
   */
  constructor(told, more) {
    const places = Object.keys(TITLES);
    super({ ...told, form: told.form.toSorted((/** @type {Section} */ a, /** @type {Section} */ b) =>
      places.indexOf(a.key) - places.indexOf(b.key)) }, more);
    /** @type {boolean} */ this.hasProfile = told.profile;
  }

  /**
   * Whether a certificate needs an entry that is missing, or has the value of the template.
   * @param {Part[]} path
   */
  lacks(path) {
    const key = plain(keyPath(path));
    return this.now.missing.some((entry) => plain(entry.key) === key);
  }

  /** @param {Section} section */
  section(section) {
    const { key } = section;
    const fields = key === "evidence" ? this.evidenceFields(section.fields) : section.fields;
    const details = super.section({ ...section, fields });
    details.open = this.now.missing.some((entry) => sectionOf(entry.key) === key);
    details.querySelector("summary")?.replaceChildren(titleOf(key),
      make("span", { class: "quiet" }, this.contentOf(key)));
    if (key === "laboratory") details.append(this.profileRow());
    return details;
  }

  /**
   * Fields of [evidence]; those that are needed have the reason as help.
   * @param {Field[]} fields
   */
  evidenceFields(fields) {
    const needed = this.now.missing.filter(({ key }) => key.startsWith("evidence."));
    const names = needed.map(({ key }) => key.slice("evidence.".length));
    const text = (/** @type {string} */ key, /** @type {string} */ help) => ({
      key, label: fields.find((field) => field.key === key)?.label ?? key, help, links: [], kind: "text", required: false, example: "Type test TR-12",
    });
    return [...needed.map(({ words }, place) => text(names[place], words)),
      ...Object.keys(this.now.document.evidence ?? {})
        .filter((key) => !names.includes(key) && fields.every((field) => field.key !== key))
        .map((key) => text(key, "")),
      ...fields.filter(({ key }) => !names.includes(key))
        .map((field) => (field.key === "all" ? { ...field, visible: needed.length > 1 } : field))];
  }

  /**
   * The first values of a section, for its summary.
   * @param {string} key
   */
  contentOf(key) {
    const value = this.now.document[key];
    const table = Array.isArray(value) ? value[0] : value;
    const path = Array.isArray(value) ? [key, 0] : [key];
    return Object.entries(table ?? {})
      .filter(([name, text]) => typeof text === "string" && !this.lacks([...path, name]))
      .slice(0, SHOWN_VALUES).map(([, text]) => text).join(", ");
  }

  profileRow() {
    return make("div", { class: "row" }, this.profileButton(), make("p", { class: "help" },
      "The laboratory profile provides the laboratory, persons and traceability entries for the next certificate."));
  }

  profileButton() {
    return make("button", {
      type: "button",
      onclick: () => this.saveProfile().catch((error) => say(error.message)),
    }, "Save laboratory profile");
  }

  async saveProfile() {
    await this.last;
    const { file } = await send("POST", "profile", { file: this.file, text: this.now.text });
    this.hasProfile = true;
    say(`Saved the laboratory profile as ${file}.`);
  }

  /** Mark fields with mistakes; `gaps` lists them. */
  showProblems() {
    super.showProblems();
    this.notes.firstElementChild?.remove();
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
    const place = super.field(field, path, this.lacks(path) ? undefined : value);
    if (field.required) {
      place.querySelector("label")?.firstChild?.after(make("span", { class: "required", "aria-hidden": "true" }, " *"));
    }
    return place;
  }

  /**
   * @param {string} key
   * @returns {HTMLElement | undefined}
   */
  placeOf(key) {
    for (let name = plain(key); name; name = name.replace(/(^|\.)[^.]*$/, "")) {
      const found = [...this.places ?? []].find(([path]) => plain(path) === name);
      if (found) return found[1];
    }
    return undefined;
  }

  /** What prevents the issue of a certificate, in the order of the form. */
  gaps() {
    const found = [
      ...this.now.missing.map(({ key, words }) => ({
        key, words: key.startsWith("evidence.") ? words.replace(/^is missing; /, "") : "",
      })),
      ...this.now.problems.map(({ key, words }) => ({ key, words })),
    ].map(({ key, words }) => ({
      place: this.form.findIndex((section) => section.key === sectionOf(key)),
      section: titleOf(sectionOf(key)),
      text: this.labelOf(key),
      words,
      go: () => this.focus(key),
      leaveOut: this.canLeaveOut(key) ? () => this.leaveOut(key) : null,
    }));
    return found.sort((a, b) => a.place - b.place);
  }

  /** @param {string} key */
  labelOf(key) {
    const label = this.placeOf(key)?.querySelector(":scope > label")?.firstChild?.textContent;
    return label || key || "the text";
  }

  /** @param {string} key */
  focus(key) {
    const place = this.placeOf(key);
    for (let up = place?.closest("details"); up; up = up.parentElement?.closest("details")) up.open = true;
    const control = /** @type {HTMLElement | null | undefined} */ (place?.querySelector("input, select, textarea"));
    control?.scrollIntoView({ block: "center" });
    control?.focus({ preventScroll: true });
  }

  /**
   * Whether an entry with the value of the template may be removed instead.
   * @param {string} key
   */
  canLeaveOut(key) {
    const [section, name] = key.split(".");
    const field = this.form.find((one) => one.key === section)?.fields.find((one) => one.key === name);
    return Boolean(field && !field.required && this.now.document[section]?.[name] !== undefined);
  }

  /** @param {string} key */
  leaveOut(key) {
    return this.change(key.split("."), null);
  }
}
