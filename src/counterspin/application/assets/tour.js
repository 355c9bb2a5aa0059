// @ts-check
// A tour of the sample campaign, in a few steps.

import { make } from "./dom.js";

/** The campaign whose tour is wanted, for this window. */
const KEY = "counterspin-tour";

/** Steps: what is shown, its title and its explanation. */
const STEPS = [
  [".steps", "Five steps", "A campaign leads from the files to a certificate. This sample has simulated records, and its calibration is done."],
  [".instrument", "The result", "K_II with its standard uncertainty u and its 95 % interval. The bar shows the sources of u, and the checks below it test the fit."],
  ['[role="tablist"]', "The chapters", "The uncertainty budget has sliders: they show u if a source were known better. Residuals show data minus model, and Inputs all files with checksums."],
  [".head .row", "Report and certificate", "Save a report, copy the values, or issue a certificate. The sample is for practice: its certificate stays a draft until you state a laboratory."],
  [".steps .menu", "Description and records", "More leads to the description with every setting, the records as plots, a forecast and a study. The Glossary explains the terms."],
];

/** @param {string} name of the campaign that is shown next */
export const requestTour = (name) => sessionStorage.setItem(KEY, name);

/**
 * The tour of a campaign; null if it is not wanted, or was closed.
 * @param {string} name
 * @returns {HTMLElement|null}
 */
export function tourOf(name) {
  if (sessionStorage.getItem(KEY) !== name) return null;
  let now = 0;
  const title = make("h2"), text = make("p"), count = make("span", { class: "quiet" });
  const back = make("button", { type: "button", onclick: () => show(now - 1) }, "Back");
  const next = make("button", { type: "button", class: "main", onclick: () => (now + 1 < STEPS.length ? show(now + 1) : close()) });
  const box = make("aside", {
    class: "tour panel", role: "dialog", "aria-label": "Tour of the sample campaign",
    onkeydown: (/** @type {KeyboardEvent} */ event) => { if (event.key === "Escape") close(); },
  }, title, make("div", { "aria-live": "polite" }, text),
  make("div", { class: "row" }, count, back, next, make("button", { type: "button", onclick: () => close() }, "Close the tour")));
  const unmark = () => document.querySelectorAll(".toured").forEach((element) => element.classList.remove("toured"));
  const close = () => {
    sessionStorage.removeItem(KEY);
    unmark();
    box.remove();
  };
  const show = (/** @type {number} */ step) => {
    now = step;
    const [selector, words, explained] = STEPS[step];
    unmark();
    document.querySelector(selector)?.classList.add("toured");
    document.querySelector(selector)?.scrollIntoView({ block: "nearest" });
    title.textContent = words;
    text.textContent = explained;
    count.textContent = `${step + 1} of ${STEPS.length}`;
    back.disabled = step === 0;
    next.textContent = step + 1 < STEPS.length ? "Next" : "Done";
  };
  // The page is not drawn before its view is returned.
  setTimeout(() => show(0));
  return box;
}
