// @ts-check
// One campaign: calibrate, and what came of it.

import { resultAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { commandLine, labelled, make, stateMark, warning } from "./dom.js";
import { resultLines } from "./folder.js";
import { follow } from "./job.js";
import { pagePart, resultLinks } from "./result.js";
import { campaignTabs } from "./tabs.js";

/** @typedef {import("./job.js").Job} Job */

/**
 * Show a result that has just been made: here, or in its own place if it is not the campaign's.
 * @param {string} campaign
 * @param {string} output
 */
async function showResult(campaign, output) {
  const { results } = await get("campaign", { name: campaign });
  if (results[0]?.name === output) dispatchEvent(new HashChangeEvent("hashchange"));
  else location.hash = resultAddress(output);
}

/**
 * How the campaign is calibrated, and the button.
 * @param {any} campaign
 */
function calibration(campaign) {
  const place = make("div");
  const method = make("select", {},
    make("option", { value: "joint" }, "Joint: all samples in one fit"),
    make("option", { value: "two-stage" }, "Two-stage: the paper's"));
  const output = make("input", { value: "result.json", required: true, autocomplete: "off" });
  const reason = make("input", { autocomplete: "off" });
  const form = make("form", {
    onsubmit: async (/** @type {Event} */ event) => {
      event.preventDefault();
      try {
        const job = await send("POST", "jobs", {
          name: campaign.name,
          output: output.value,
          method: method.value,
          accept_misfit: reason.value.trim() || undefined,
        });
        follow(job, place, () => showResult(campaign.name, job.output));
      } catch (error) {
        place.replaceChildren(warning(/** @type {Error} */ (error).message));
      }
    },
  },
  make("div", { class: "row" },
    make("button", { class: "main", disabled: campaign.mistakes.length > 0 }, "Calibrate"),
    labelled("Method", method),
    labelled("Result's file; an earlier result is replaced", output),
    campaign.state === "contradicted"
      ? labelled("Use it although the records contradict it: why", reason) : null));
  const running = campaign.jobs.find(/** @param {Job} job */ ({ kind, state }) =>
    kind === "calibration" && (state === "waiting" || state === "running"));
  if (running) follow(running, place, () => showResult(campaign.name, running.output));
  return [form, place, commandLine(campaign.command)];
}

/**
 * The page of a campaign.
 * @param {string} name
 */
export async function campaignView(name) {
  const campaign = await get("campaign", { name });
  const result = campaign.results[0];
  /** @type {Node[]} */
  const content = [
    make("h1", {}, campaign.title),
    campaignTabs(name, "campaign"),
    make("p", {}, stateMark(campaign.state, campaign.words), ` ${campaign.name}`),
    ...campaign.mistakes.map(warning),
    ...(campaign.missing.length
      ? [warning(`Not there: ${campaign.missing.join(", ")}`)] : []),
    ...calibration(campaign),
  ];
  if (campaign.results.length > 1) {
    content.push(make("section", {}, make("h2", {}, "Results"),
      make("ul", { class: "cards" }, ...campaign.results.map(/** @param {any} r */ (r) =>
        make("li", { class: "card" }, ...resultLines(r))))));
  }
  if (result && result.state !== "damaged") {
    const { told, part } = await pagePart("result", [result.name]);
    // The campaign's own title stands above.
    part?.querySelector("h1")?.remove();
    content.push(make("section", { "aria-label": "Result" }, ...part ? [part] : []),
      resultLinks(result.name), commandLine(told.command));
  }
  return { title: campaign.title, content };
}
