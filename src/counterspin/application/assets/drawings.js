// @ts-check
// Drawings of the machine, next to the fields that they explain.

import { attempt, make } from "./dom.js";

/** Drawing -> its caption. */
const CAPTIONS = /** @type {Record<string, string>} */ ({
  "accelerometer": "Accelerometer axes",
  "arm": "Direction of the specific force relative to the arm",
  "double-turntable": "Zero angle and positive direction",
  "tumble": "Zero angle and positive direction",
});

/** Drawings that are open, so that they stay open when fields are redrawn. */
const openDrawings = /** @type {Set<string>} */ (new Set());

/**
 * A drawing that is loaded when it is opened.
 * @param {string} name
 * @param {boolean} [isOpen] opened from the beginning
 * @returns {HTMLElement}
 */
export function machineDrawing(name, isOpen = false) {
  const container = make("div");
  const details = make("details", {
    class: "machine",
    ontoggle: async () => {
      if (details.open) openDrawings.add(name);
      else openDrawings.delete(name);
      if (!details.open || container.childElementCount) return;
      await attempt(container, async () => {
        const response = await fetch(`/assets/machine-${name}.svg`);
        if (!response.ok) throw new Error(`The server responded with status ${response.status}.`);
        // A static file of the application.
        container.innerHTML = await response.text();
      });
    },
  }, make("summary", {}, CAPTIONS[name]), container);
  details.open = isOpen || openDrawings.has(name);
  return details;
}
