// @ts-check
// Fields of answers: a quantity as value, standard uncertainty and unit; a choice; a text.

import { make } from "./dom.js";

/**
 * A question, and its possible answers.
 * @typedef {import("./answers.js").QuestionEntry} Question
 */

/**
 * A field: its element, its first control, and what it does with an answer.
 * @typedef {{element: HTMLElement, control: HTMLInputElement|HTMLSelectElement, read: () => string,
 *   write: (text: string) => void, active: () => boolean, judge: (mistake: string|undefined) => void}} Field
 */

const NUMBER = String.raw`[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:e[-+]?\d+)?`;
const QUANTITY = new RegExp(String.raw`^\s*(${NUMBER})\s*(?:(?:±|\+/-|\+-)\s*(${NUMBER}))?\s*(.*?)\s*$`, "i");

/**
 * A quantity in parts; null if it is written otherwise, or in a unit without a place in the menu.
 * @param {string} text such as "2.5 ± 1e-5 m"
 * @param {string[]} units
 * @returns {{value: string, u: string, unit: string} | null}
 */
export function partsOf(text, units) {
  const [, value, u = "", unit] = QUANTITY.exec(text) ?? [];
  return value === undefined || (unit && !units.includes(unit)) ? null : { value, u, unit };
}

/**
 * A quantity as a text; a value that is more than a number stays as it is typed.
 * @param {string} value
 * @param {string} u
 * @param {string} unit
 */
export const quantityText = (value, u, unit) =>
  (value && new RegExp(`^${NUMBER}$`, "i").test(value) ? `${value}${u && ` ± ${u}`} ${unit}` : value);

/**
 * The field of a question.
 * @param {Question} question
 * @param {string} label
 * @param {string} help below the field
 * @param {boolean} bare without a visible label
 * @param {() => void} changed called after a change, and when the field is left
 * @returns {Field}
 */
export function quantityField({ key, choices, example, guess, units = [] }, label, help, bare, changed) {
  const id = `answer-${key}`;
  /** @type {HTMLInputElement|HTMLSelectElement} */
  const control = choices.length
    ? make("select", { id }, ...(guess === null ? [""] : []).concat(choices).map((value) => make("option", { value }, value || "choose")))
    : make("input", { id, autocomplete: "off", spellcheck: "false", placeholder: units.length ? "" : example });
  const hint = make("p", { class: "help", id: `${id}-help` }, help || (units.length ? `For example ${example}.` : ""));
  const usual = hint.textContent ?? "";
  const u = make("input", { autocomplete: "off", spellcheck: "false", placeholder: "default", "aria-label": `${label}, standard uncertainty` });
  const unit = make("select", { "aria-label": `${label}, unit` }, ...units.map((value) => make("option", { value }, value.replace("^2", "²"))));
  const controls = units.length ? [control, u, unit] : [control];
  if (bare) control.setAttribute("aria-label", label);
  const row = units.length ? make("div", { class: "value-u-unit" }, control, make("span", { "aria-hidden": "true" }, "±"), u, unit) : control;
  const element = bare ? make("div", { class: "bare" }, control) : make("div", {}, make("label", { for: id }, label), row, hint);

  /** @type {Field} */
  const field = {
    element,
    control,
    read: () => (units.length ? quantityText(control.value.trim(), u.value.trim(), unit.value) : control.value.trim()),
    write(text) {
      const parts = units.length ? partsOf(text, units) : null;
      control.value = parts ? parts.value : text;
      if (parts) u.value = parts.u;
      else if (!text) u.value = "";
      if (parts?.unit) unit.value = parts.unit;
    },
    active: () => controls.some((part) => part === document.activeElement),
    judge(mistake) {
      if (mistake) control.setAttribute("aria-invalid", "true");
      else control.removeAttribute("aria-invalid");
      const shown = mistake ?? usual;
      hint.className = mistake ? "wrong" : "help";
      if (mistake) hint.setAttribute("role", "alert");
      else hint.removeAttribute("role");
      hint.textContent = shown;
      if (bare && mistake) element.append(hint);
      else if (bare) hint.remove();
      if (shown) control.setAttribute("aria-describedby", hint.id);
      else control.removeAttribute("aria-describedby");
    },
  };
  const take = () => {
    // A quantity that is typed or pasted whole is shown in its parts.
    if (units.length && (partsOf(control.value, units)?.unit || partsOf(control.value, units)?.u)) field.write(control.value);
    changed();
  };
  for (const part of controls) {
    part.addEventListener("change", take);
    // Drawn again while it was typed in, a field reports no change.
    part.addEventListener("blur", take);
    // A mistake is of the text before it was edited.
    part.addEventListener("input", () => field.judge(undefined));
  }
  return field;
}
