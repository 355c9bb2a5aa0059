// @ts-check
// The steps of a campaign, and its further pages.

import { make } from "./dom.js";
import { requestTour } from "./tour.js";

/** Further pages of a campaign: name -> title. */
const FURTHER_PAGES = { description: "Description", runs: "Records", live: "Live", try: "Try out" };

/** @typedef {"confirm" | "calibrate" | "review" | "certify"} Step the step that a campaign has reached */

const STEPS = ["Import", "Confirm", "Calibrate", "Review", "Certify"];

/**
 * The steps as a list.
 * @param {number} currentStep the present step
 * @param {(string|null)[]} [links] addresses of steps
 */
export const stepList = (currentStep, links = []) => make("ol", {}, ...STEPS.map((label, index) => {
  const link = links[index];
  return make("li", {
    class: index < currentStep ? "done" : index === currentStep ? "now" : "",
    "aria-current": index === currentStep ? "step" : null,
  }, link && (index <= currentStep || index === STEPS.length - 1) ? make("a", { href: link }, label) : make("span", {}, label));
}));

/**
 * The step that a campaign has reached, and its result.
 * @param {import("./answers.js").CampaignOverview} campaign
 * @returns {{step: Step, result?: string}}
 */
export function reachedStep({ mistakes, results: [result] }) {
  if (result && result.state !== "damaged") return { step: "review", result: result.name };
  return { step: mistakes.length ? "confirm" : "calibrate" };
}

/**
 * The steps from files to a certificate, and links to the further pages of a campaign.
 * @param {string} name
 * @param {string} currentPage
 * @param {{step: Step, result?: string}} reached
 */
export function campaignTabs(name, currentPage, { step, result }) {
  const addressOf = (/** @type {string} */ page) => `#/${page}/${encodeURIComponent(name)}`;
  const currentStep = ["import", "confirm", "calibrate", "review", "certify"].indexOf(step);
  const links = [addressOf("runs"), addressOf("description"), addressOf("campaign"), addressOf("campaign"),
    result === undefined ? null : `#/certificate/${encodeURIComponent(result)}`];
  return make("nav", { class: "steps", "aria-label": "Campaign steps" }, stepList(currentStep, links),
    make("details", { class: "menu" }, make("summary", {}, "More"),
      make("div", {}, ...Object.entries({ campaign: "Result", ...FURTHER_PAGES }).map(([page, label]) =>
        make("a", { href: addressOf(page), "aria-current": page === currentPage ? "page" : null }, label)),
      currentPage === "campaign" && result !== undefined ? make("button", {
        type: "button", class: "link",
        onclick: () => {
          requestTour(name);
          dispatchEvent(new HashChangeEvent("hashchange"));
        },
      }, "Tour") : null)));
}
