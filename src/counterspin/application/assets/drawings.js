// @ts-check
// Drawings of the machine, beside the fields that they explain.

import { attempt, make } from "./dom.js";

/** Drawing -> the question that it answers. */
const QUESTIONS = /** @type {Record<string, string>} */ ({
  "accelerometer": "Accelerometer axes",
  "arm": "Direction of the specific force on the arm",
  "double-turntable": "Zero angle and positive direction",
  "tumble": "Zero angle and positive direction",
});

/** Drawings that were shown open, so that they stay so when fields are drawn again. */
const open = /** @type {Set<string>} */ (new Set());

/**
 * A drawing that is fetched when it is opened.
 * @param {string} name
 * @param {boolean} [begin] opened from the beginning
 * @returns {HTMLElement}
 */
export function drawingOf(name, begin = false) {
  const place = make("div");
  const details = make("details", {
    class: "machine",
    ontoggle: async () => {
      if (details.open) open.add(name);
      else open.delete(name);
      if (!details.open || place.childElementCount) return;
      await attempt(place, async () => {
        const answer = await fetch(`/assets/machine-${name}.svg`);
        if (!answer.ok) throw new Error(`The server responded with status ${answer.status}.`);
        // The program's own, the same for everybody.
        place.innerHTML = await answer.text();
      });
    },
  }, make("summary", {}, QUESTIONS[name]), place);
  details.open = begin || open.has(name);
  return details;
}
