// @ts-check
// The description of a campaign: form, text and mistakes.

import { get } from "./api.js";
import { campaignTabs, reachedStep } from "./tabs.js";
import { make } from "./dom.js";
import { makeEditor } from "./editor.js";

/**
 * The page of a description.
 * @param {string} name
 * @param {string} initialId the field or section to scroll to
 */
export async function descriptionView(name, initialId) {
  const [file, campaign] = await Promise.all([get("description", { name }), get("campaign", { name })]);
  const title = file.document.campaign?.title || name || "Campaign";
  return {
    title: `Description: ${title}`,
    content: [make("h1", {}, `Description: ${title}`), campaignTabs(name, "description", reachedStep(campaign)), makeEditor(file).element],
    begin: initialId,
  };
}
