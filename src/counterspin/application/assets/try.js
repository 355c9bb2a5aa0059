// @ts-check
// A campaign before recording: forecast, study and simulated records.

import { get, send } from "./api.js";
import { commandLine, labelled, make } from "./dom.js";
import { campaignAddress, descriptionAddress } from "./addresses.js";
import { jobStarter, duration, follow, followRunning } from "./job.js";
import { fillContainer } from "./result.js";
import { campaignTabs, reachedStep } from "./tabs.js";

/**
 * A form that starts a job; an active job is followed.
 * @param {import("./answers.js").CampaignOverview} campaign
 * @param {string} kind
 * @param {HTMLElement} label
 * @param {string} buttonLabel of the button
 * @param {() => Promise<import("./job.js").Job>} startJob
 * @param {(job: import("./job.js").Job) => void} onDone
 */
function jobForm(campaign, kind, label, buttonLabel, startJob, onDone) {
  const container = make("div");
  const finish = (/** @type {import("./job.js").Job} */ job) => {
    container.replaceChildren(commandLine(job.command));
    onDone(job);
  };
  followRunning(campaign.jobs, kind, container, finish);
  const form = make("form", {
    class: "row",
    onsubmit: jobStarter(container, startJob, finish),
  }, label, make("button", { class: "main" }, buttonLabel));
  return [form, container];
}

/**
 * The expected duration of a study for the number of trials.
 * @param {string} name of the campaign
 * @param {HTMLInputElement} trials
 */
function durationPart(name, trials) {
  const container = make("div", { class: "quiet", role: "status" });
  const estimate = async () => {
    try {
      const { job, duration: estimated } = await send("POST", "study-duration", { name });
      if (job) return follow(job, container, estimate);
      if (!estimated) return;
      const show = () => {
        const seconds = estimated.preparation + Number(trials.value) * estimated.per_trial;
        container.textContent = `${Number(trials.value).toLocaleString("en")} trials take about ${duration(seconds)}.` +
          (estimated.slow_analyses ? ` Each trial takes ${estimated.per_trial.toPrecision(2)} s: ${estimated.slow_analyses}.` : "");
      };
      trials.addEventListener("input", show);
      show();
    } catch (error) {
      container.textContent = /** @type {Error} */ (error).message;
    }
  };
  setTimeout(estimate);
  return container;
}

/**
 * The page with forecast, study and simulation of a campaign.
 * @param {string} name
 */
export async function tryView(name) {
  const campaign = await get("campaign", { name });
  const forecastContainer = make("div");
  const studyContainer = make("div");
  const simulationMessage = make("p", { "aria-live": "polite" });
  const trials = make("input", { type: "number", min: 2, max: 1000000, value: 1000, required: true });
  const folder = make("input", { required: true, autocomplete: "off", value: `${name || "simulated"}-simulated` });
  const showStudy = () => fillContainer(studyContainer, "study", [`${name}${name && "/"}study.json`]);
  const file = `${name}${name && "/"}campaign.toml`;
  setTimeout(() => fillContainer(forecastContainer, "forecast", [file]));
  if (campaign.study) setTimeout(showStudy);
  return {
    title: `Try out: ${campaign.title}`,
    content: [
      make("h1", {}, `Try out: ${campaign.title}`), campaignTabs(name, "try", reachedStep(campaign)),
      make("section", {}, make("h2", {}, "Study"),
        make("p", { class: "quiet" }, "A study simulates the campaign many times with the true values in the ",
          make("a", { href: descriptionAddress(name, "s-truth") }, "description"),
          " and calibrates each simulation. The result shows whether the stated uncertainties are valid."),
        durationPart(name, trials),
        ...jobForm(campaign, "study", labelled("Number of trials", trials), "Run study",
          () => send("POST", "study", { name, trials: Number(trials.value) }),
          () => showStudy().then(() => studyContainer.scrollIntoView()))),
      make("section", {}, make("h2", {}, "Simulated records"),
        make("p", { class: "quiet" }, "counterspin simulates records from the true values in the description and writes them to a separate folder."),
        ...jobForm(campaign, "simulation", labelled("Folder for the records", folder), "Simulate",
          () => send("POST", "simulation", { name, folder: folder.value }),
          (job) => simulationMessage.replaceChildren("The records are in ",
            make("a", { href: campaignAddress(job.output) }, job.output), ".")),
        simulationMessage),
      studyContainer,
      make("section", {}, make("h2", {}, "Forecast"),
        make("p", { class: "quiet" }, "The forecast calculates the expected uncertainties from the description. If the description lacks noise, rates or "
          + "durations, counterspin takes them from existing records of the runs."), forecastContainer),
    ],
  };
}
