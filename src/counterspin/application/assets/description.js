// @ts-check
// The description of a campaign: form, text and mistakes.

import { get } from "./api.js";
import { campaignTabs, reachedBy } from "./tabs.js";
import { make } from "./dom.js";
import { editorOf } from "./editor.js";

/**
 * The page of a description.
 * @param {string} name
 * @param {string} begin the field or section that is looked at first
 */
export async function descriptionView(name, begin) {
  const [told, campaign] = await Promise.all([get("description", { name }), get("campaign", { name })]);
  const title = told.document.campaign?.title || name || "Campaign";
  return {
    title: `Description: ${title}`,
    content: [make("h1", {}, title), campaignTabs(name, "description", reachedBy(campaign)), editorOf(told).element],
    begin,
  };
}
