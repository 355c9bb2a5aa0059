// @ts-check
// The places of one campaign.

import { make } from "./dom.js";

/** Its address -> what it is called. */
const TABS = {
  campaign: "Result", description: "Description", runs: "Records", live: "Live", try: "Try out",
};

/**
 * Links to the places of a campaign.
 * @param {string} name
 * @param {string} here
 */
export const campaignTabs = (name, here) =>
  make("nav", { class: "tabs", "aria-label": "The campaign" },
    ...Object.entries(TABS).map(([place, words]) => make("a", {
      href: `#/${place}/${encodeURIComponent(name)}`,
      "aria-current": place === here ? "page" : null,
    }, words)));
