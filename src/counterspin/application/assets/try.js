// @ts-check
// A campaign before it is recorded: its forecast, a study of many trials, simulated records.

import { get, send } from "./api.js";
import { commandLine, labelled, make, warning } from "./dom.js";
import { campaignAddress } from "./addresses.js";
import { follow } from "./job.js";
import { fill } from "./result.js";
import { campaignTabs } from "./tabs.js";

/**
 * A form that begins a job, and the job that goes on already.
 * @param {any} campaign
 * @param {string} kind
 * @param {HTMLElement} label
 * @param {string} words of the button
 * @param {() => Promise<any>} begin
 * @param {(job: any) => void} done
 */
function jobForm(campaign, kind, label, words, begin, done) {
  const place = make("div");
  const running = campaign.jobs.find(/** @param {any} job */ (job) =>
    job.kind === kind && (job.state === "waiting" || job.state === "running"));
  if (running) follow(running, place, () => done(running));
  const form = make("form", {
    class: "row",
    onsubmit: async (/** @type {Event} */ event) => {
      event.preventDefault();
      try {
        const job = await begin();
        follow(job, place, () => {
          place.replaceChildren(commandLine(job.command));
          done(job);
        });
      } catch (error) {
        place.replaceChildren(warning(/** @type {Error} */ (error).message),
          make("p", {}, make("a", { href: `#/description/${encodeURIComponent(campaign.name)}` }, "Open the description")));
      }
    },
  }, label, make("button", { class: "main" }, words));
  return [form, place];
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
    title: `${campaign.title}, tried out`,
    content: [
      make("h1", {}, campaign.title), campaignTabs(name, "try"),
      make("section", {}, make("h2", {}, "Study"),
        make("p", { class: "quiet" }, "Simulated many times with the true values of the description, and analysed "
          + "each time: do the uncertainties hold? A thousand trials take seconds."),
        ...jobForm(campaign, "study", labelled("Trials", trials), "Study",
          () => send("POST", "study", { name, trials: Number(trials.value) }),
          () => showStudy().then(() => studied.scrollIntoView()))),
      make("section", {}, make("h2", {}, "Simulated records"),
        make("p", { class: "quiet" }, "Records that the true values of the description would give, in a folder of their own."),
        ...jobForm(campaign, "simulation", labelled("Folder of the records", folder), "Simulate",
          () => send("POST", "simulation", { name, folder: folder.value }),
          (job) => simulated.replaceChildren("The records are in ",
            make("a", { href: campaignAddress(job.output) }, job.output), ".")),
        simulated),
      studied,
      make("section", {}, make("h2", {}, "Forecast"),
        make("p", { class: "quiet" }, "Expected uncertainties, by the description; where it leaves noise, rate or length "
          + "of the runs to records that are there, by these."), forecast),
    ],
  };
}
