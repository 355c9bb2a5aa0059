// @ts-check
// A tour of a calibrated campaign, in a few steps.

import { make, setSymbols } from "./dom.js";

/** Name of the session storage entry with the campaign of the requested tour. */
const KEY = "counterspin-tour";

/** Steps: selector of the highlighted element, title and explanation. */
const STEPS = [
  [".steps", "Five steps", "A campaign has five steps, from the files to the certificate. This campaign has been calibrated; the Review step shows the result."],
  [".instrument", "Result", "Each card shows K_II with its standard uncertainty u and its 95 % interval. The bar shows the sources of u; the checks below the bar test the fit."],
  ['[role="tablist"]', "Tabs", "The sliders in the uncertainty budget show how u would decrease if a source were known more accurately. The Residuals tab shows data minus model. The Inputs tab lists all files with checksums."],
  [".head .row", "Report and certificate", "Save a report, copy the values, or issue a certificate. A certificate remains a draft until all laboratory entries are complete."],
  [".steps .menu", "Description and records", "The ‘More’ menu leads to the record plots, a forecast, a study, and the description with every setting. The glossary explains the terms."],
];

/** @param {string} name of the campaign that is shown next */
export const requestTour = (name) => sessionStorage.setItem(KEY, name);

/**
 * The tour of a campaign; null if it was not requested, or was closed.
 * @param {string} name
 * @returns {HTMLElement|null}
 */
export function makeTour(name) {
  if (sessionStorage.getItem(KEY) !== name) return null;
  let currentStep = 0;
  const title = make("h2"), text = make("p"), stepText = make("span", { class: "quiet" });
  const back = make("button", { type: "button", onclick: () => show(currentStep - 1) }, "Back");
  const next = make("button", { type: "button", class: "main", onclick: () => (currentStep + 1 < STEPS.length ? show(currentStep + 1) : close()) });
  const box = make("aside", {
    class: "tour panel", role: "dialog", "aria-label": "Campaign tour",
    onkeydown: (/** @type {KeyboardEvent} */ event) => { if (event.key === "Escape") close(); },
  }, title, make("div", { "aria-live": "polite" }, text),
  make("div", { class: "row" }, stepText, back, next, make("button", { type: "button", onclick: () => close() }, "Close tour")));
  const unmark = () => document.querySelectorAll(".toured").forEach((element) => element.classList.remove("toured"));
  const close = () => {
    sessionStorage.removeItem(KEY);
    unmark();
    box.remove();
  };
  const show = (/** @type {number} */ step) => {
    currentStep = step;
    const [selector, stepTitle, explanation] = STEPS[step];
    unmark();
    document.querySelector(selector)?.classList.add("toured");
    document.querySelector(selector)?.scrollIntoView({ block: "nearest" });
    title.textContent = stepTitle;
    text.replaceChildren(...setSymbols(explanation));
    stepText.textContent = `${step + 1} of ${STEPS.length}`;
    back.disabled = step === 0;
    next.textContent = step + 1 < STEPS.length ? "Next" : "Done";
  };
  // The page is drawn after the view is returned.
  setTimeout(() => show(0));
  return box;
}
