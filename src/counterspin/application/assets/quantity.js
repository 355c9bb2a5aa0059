// @ts-check
// Fields of answers: quantities with standard uncertainty and unit, choices and texts.

import { make } from "./dom.js";

/**
 * A question, and its possible answers.
 * @typedef {import("./answers.js").QuestionEntry} Question
 */

/**
 * A field: its element, its first control, and its functions.
 * @typedef {{element: HTMLElement, control: HTMLInputElement|HTMLSelectElement, read: () => string,
 *   write: (text: string) => void, active: () => boolean, judge: (mistake: string|undefined) => void}} Field
 */

const NUMBER = String.raw`[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:e[-+]?\d+)?`;
const QUANTITY = new RegExp(String.raw`^\s*(${NUMBER})\s*(?:(?:±|\+/-|\+-)\s*(${NUMBER}))?\s*(.*?)\s*$`, "i");

/**
 * Value, u and unit of a quantity; null for other text, or for a unit that is not in the menu.
 * @param {string} text such as "2.5 ± 1e-5 m"
 * @param {string[]} units
 * @returns {{value: string, u: string, unit: string} | null}
 */
export function splitQuantity(text, units) {
  const [, value, u = "", unit] = QUANTITY.exec(text) ?? [];
  return value === undefined || (unit && !units.includes(unit)) ? null : { value, u, unit };
}

/**
 * A quantity as text; a value that is not a number is unchanged.
 * @param {string} value
 * @param {string} u
 * @param {string} unit
 */
export const joinQuantity = (value, u, unit) =>
  (value && new RegExp(`^${NUMBER}$`, "i").test(value) ? `${value}${u && ` ± ${u}`} ${unit}` : value);

/**
 * The field of a question.
 * @param {Question} question
 * @param {string} label
 * @param {string} help below the field
 * @param {boolean} isBare without a visible label
 * @param {() => void} onChange called after a change, and when the field is left
 * @returns {Field}
 */
export function quantityField({ key, choices, example, guess, units = [] }, label, help, isBare, onChange) {
  const id = `answer-${key}`;
  /** @type {HTMLInputElement|HTMLSelectElement} */
  const control = choices.length
    // A detected value, such as a unit, need not be one of the usual choices.
    ? make("select", { id }, ...(guess === null ? [""] : choices.includes(guess) ? [] : [guess]).concat(choices).map((value) => make("option", { value }, value || "choose")))
    : make("input", { id, autocomplete: "off", spellcheck: "false", placeholder: units.length ? "" : example });
  const hint = make("p", { class: "help", id: `${id}-help` }, help || (units.length ? `For example ${example}.` : ""));
  const usualHint = hint.textContent ?? "";
  const uInput = make("input", { autocomplete: "off", spellcheck: "false", placeholder: "default", "aria-label": `${label}, standard uncertainty` });
  const unitSelect = make("select", { "aria-label": `${label}, unit` }, ...units.map((value) => make("option", { value }, value.replace("^2", "²"))));
  const controls = units.length ? [control, uInput, unitSelect] : [control];
  if (isBare) control.setAttribute("aria-label", label);
  const row = units.length ? make("div", { class: "value-u-unit" }, control, make("span", { "aria-hidden": "true" }, "±"), uInput, unitSelect) : control;
  const element = isBare ? make("div", { class: "bare" }, control) : make("div", {}, make("label", { for: id }, label), row, hint);

  /** @type {Field} */
  const field = {
    element,
    control,
    read: () => (units.length ? joinQuantity(control.value.trim(), uInput.value.trim(), unitSelect.value) : control.value.trim()),
    write(text) {
      const parts = units.length ? splitQuantity(text, units) : null;
      control.value = parts ? parts.value : text;
      if (parts) uInput.value = parts.u;
      else if (!text) uInput.value = "";
      if (parts?.unit) unitSelect.value = parts.unit;
    },
    active: () => controls.some((control) => control === document.activeElement),
    judge(mistake) {
      if (mistake) control.setAttribute("aria-invalid", "true");
      else control.removeAttribute("aria-invalid");
      const hintText = mistake ?? usualHint;
      hint.className = mistake ? "wrong" : "help";
      if (mistake) hint.setAttribute("role", "alert");
      else hint.removeAttribute("role");
      hint.textContent = hintText;
      if (isBare && mistake) element.append(hint);
      else if (isBare) hint.remove();
      if (hintText) control.setAttribute("aria-describedby", hint.id);
      else control.removeAttribute("aria-describedby");
    },
  };
  const applyInput = () => {
    // Split a complete quantity that was typed or pasted.
    if (units.length && (splitQuantity(control.value, units)?.unit || splitQuantity(control.value, units)?.u)) field.write(control.value);
    onChange();
  };
  for (const control of controls) {
    control.addEventListener("change", applyInput);
    // A field that is redrawn while the user types does not report a change.
    control.addEventListener("blur", applyInput);
    // The mistake refers to the previous text.
    control.addEventListener("input", () => field.judge(undefined));
  }
  return field;
}
