// @ts-check
// The steps of a campaign, and its further places.

import { make } from "./dom.js";
import { requestTour } from "./tour.js";

/** Further places of a campaign: address -> title. */
const PLACES = { description: "Description", runs: "Records", live: "Live", try: "Try out" };

/** @typedef {"confirm" | "calibrate" | "review" | "certify"} Step the step that a campaign has reached */

const STEPS = ["Import", "Confirm", "Calibrate", "Review", "Certify"];

/**
 * The steps as a list.
 * @param {number} now the present step
 * @param {(string|null)[]} [links] addresses of steps
 */
export const stepList = (now, links = []) => make("ol", {}, ...STEPS.map((words, place) => {
  const link = links[place];
  return make("li", {
    class: place < now ? "done" : place === now ? "now" : "",
    "aria-current": place === now ? "step" : null,
  }, link && (place <= now || place === STEPS.length - 1) ? make("a", { href: link }, words) : make("span", {}, words));
}));

/**
 * The step that a campaign has reached, and its result.
 * @param {import("./answers.js").CampaignOverview} campaign
 * @returns {{step: Step, result?: string}}
 */
export function reachedBy({ mistakes, results: [result] }) {
  if (result && result.state !== "damaged") return { step: "review", result: result.name };
  return { step: mistakes.length ? "confirm" : "calibrate" };
}

/**
 * The steps from files to a certificate, and links to the further places of a campaign.
 * @param {string} name
 * @param {string} here
 * @param {{step: Step, result?: string}} reached
 */
export function campaignTabs(name, here, { step, result }) {
  const at = (/** @type {string} */ place) => `#/${place}/${encodeURIComponent(name)}`;
  const now = ["import", "confirm", "calibrate", "review", "certify"].indexOf(step);
  const links = [at("runs"), at("description"), at("campaign"), at("campaign"),
    result === undefined ? null : `#/certificate/${encodeURIComponent(result)}`];
  return make("nav", { class: "steps", "aria-label": "Campaign steps" }, stepList(now, links),
    make("details", { class: "menu" }, make("summary", {}, "More"),
      make("div", {}, ...Object.entries({ campaign: "Result", ...PLACES }).map(([place, words]) =>
        make("a", { href: at(place), "aria-current": place === here ? "page" : null }, words)),
      here === "campaign" && result !== undefined ? make("button", {
        type: "button", class: "link",
        onclick: () => {
          requestTour(name);
          dispatchEvent(new HashChangeEvent("hashchange"));
        },
      }, "Tour") : null)));
}
