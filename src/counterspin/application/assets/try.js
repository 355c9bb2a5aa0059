// @ts-check
// A campaign before it is recorded: its forecast, a study of many trials, simulated records.

import { get, send } from "./api.js";
import { commandLine, labelled, make } from "./dom.js";
import { campaignAddress, descriptionAddress } from "./addresses.js";
import { carryOut, duration, follow, followRunning } from "./job.js";
import { fill } from "./result.js";
import { campaignTabs, reachedBy } from "./tabs.js";

/**
 * A form that begins a job, and the job that goes on already.
 * @param {import("./answers.js").CampaignOverview} campaign
 * @param {string} kind
 * @param {HTMLElement} label
 * @param {string} words of the button
 * @param {() => Promise<import("./job.js").Job>} begin
 * @param {(job: import("./job.js").Job) => void} done
 */
function jobForm(campaign, kind, label, words, begin, done) {
  const place = make("div");
  const end = (/** @type {import("./job.js").Job} */ job) => {
    place.replaceChildren(commandLine(job.command));
    done(job);
  };
  followRunning(campaign.jobs, kind, place, end);
  const form = make("form", {
    class: "row",
    onsubmit: carryOut(place, begin, end),
  }, label, make("button", { class: "main" }, words));
  return [form, place];
}

/**
 * The expected duration of a study, which follows the number of trials.
 * @param {string} name of the campaign
 * @param {HTMLInputElement} trials
 */
function durationPart(name, trials) {
  const place = make("div", { class: "quiet", role: "status" });
  const estimate = async () => {
    try {
      const { job, duration: expected } = await send("POST", "study-duration", { name });
      if (job) return follow(job, place, estimate);
      if (!expected) return;
      const show = () => {
        const seconds = expected.preparation + Number(trials.value) * expected.per_trial;
        place.textContent = `${Number(trials.value).toLocaleString("en")} trials take about ${duration(seconds)}.` +
          (expected.slow_analyses ? ` Each trial takes ${expected.per_trial.toPrecision(2)} s: ${expected.slow_analyses}.` : "");
      };
      trials.addEventListener("input", show);
      show();
    } catch (error) {
      place.textContent = /** @type {Error} */ (error).message;
    }
  };
  setTimeout(estimate);
  return place;
}

/**
 * The page on which a campaign is tried out.
 * @param {string} name
 */
export async function tryView(name) {
  const campaign = await get("campaign", { name });
  const forecast = make("div");
  const studied = make("div");
  const simulated = make("p", { "aria-live": "polite" });
  const trials = make("input", { type: "number", min: 2, max: 1000000, value: 1000, required: true });
  const folder = make("input", { required: true, autocomplete: "off", value: `${name || "simulated"}-simulated` });
  const showStudy = () => fill(studied, "study", [`${name}${name && "/"}study.json`]);
  const file = `${name}${name && "/"}campaign.toml`;
  setTimeout(() => fill(forecast, "forecast", [file]));
  if (campaign.study) setTimeout(showStudy);
  return {
    title: `Try out: ${campaign.title}`,
    content: [
      make("h1", {}, campaign.title), campaignTabs(name, "try", reachedBy(campaign)),
      make("section", {}, make("h2", {}, "Study"),
        make("p", { class: "quiet" }, "A study simulates the campaign many times with the true values in the ",
          make("a", { href: descriptionAddress(name, "s-truth") }, "description"),
          " and calibrates each simulation. The result shows whether the stated uncertainties are valid."),
        durationPart(name, trials),
        ...jobForm(campaign, "study", labelled("Number of trials", trials), "Run study",
          () => send("POST", "study", { name, trials: Number(trials.value) }),
          () => showStudy().then(() => studied.scrollIntoView()))),
      make("section", {}, make("h2", {}, "Simulated records"),
        make("p", { class: "quiet" }, "counterspin simulates records from the true values in the description and writes them to a separate folder."),
        ...jobForm(campaign, "simulation", labelled("Folder for the records", folder), "Simulate",
          () => send("POST", "simulation", { name, folder: folder.value }),
          (job) => simulated.replaceChildren("The records are in ",
            make("a", { href: campaignAddress(job.output) }, job.output), ".")),
        simulated),
      studied,
      make("section", {}, make("h2", {}, "Forecast"),
        make("p", { class: "quiet" }, "The forecast calculates the expected uncertainties from the description. If the description lacks noise, rates or "
          + "durations, counterspin takes them from existing records of the runs."), forecast),
    ],
  };
}
