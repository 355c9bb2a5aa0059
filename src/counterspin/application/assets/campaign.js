// @ts-check
// One campaign: calibrate, and what came of it.

import { campaignAddress, descriptionAddress, resultAddress } from "./addresses.js";
import { bring, get, send } from "./api.js";
import { attempt, command, commandLine, labelled, make, say, stateMark, warning, working } from "./dom.js";
import { resultLines } from "./folder.js";
import { carryOut, followRunning } from "./job.js";
import { dashboard, pagePart } from "./result.js";
import { campaignTabs, reachedBy } from "./tabs.js";
import { tourOf } from "./tour.js";

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
 * The button that calibrates the campaign, and below it how: by which method, into which file.
 * @param {import("./answers.js").CampaignOverview} campaign
 */
function calibration(campaign) {
  const place = make("div");
  const method = make("select", {},
    make("option", { value: "joint" }, "Joint method: all samples in one fit"),
    make("option", { value: "two-stage" }, "Two-stage method of the paper"));
  const output = make("input", { value: "result.json", required: true, autocomplete: "off" });
  const reason = make("input", { autocomplete: "off" });
  const show = (/** @type {import("./job.js").Job} */ job) => showResult(campaign.name, job.output);
  const button = make("button", { class: campaign.results.length ? "" : "main", form: "calibration", disabled: campaign.mistakes.length > 0 },
    campaign.results.length ? "Calibrate again" : "Calibrate");
  const form = make("form", {
    id: "calibration",
    onsubmit: carryOut(place, () => send("POST", "jobs", {
      name: campaign.name,
      output: output.value,
      method: method.value,
      accept_misfit: reason.value.trim() || undefined,
    }), show),
  },
  campaign.state === "contradicted"
    ? labelled("Reason for accepting the misfit", reason) : null,
  make("details", { class: "aside" }, make("summary", {}, "Method, result file and command"),
    make("div", { class: "row" }, labelled("Method", method),
      labelled("Result file (an existing result is replaced)", output)),
    command(campaign.command)));
  followRunning(campaign.jobs, "calibration", place, show);
  return { button, below: [place, form] };
}

/**
 * The optional entries of the description that matter to the result, with links to their fields.
 * @param {import("./answers.js").CampaignOverview} campaign
 */
const checklistPart = (campaign) => make("section", { class: "panel" }, make("h2", {}, "Checklist"),
  make("p", { class: "quiet" }, "All entries are optional."),
  make("ul", { class: "checklist" }, ...campaign.checklist.map(({ words, stated, effect, key }) =>
    make("li", { class: stated ? "done" : "optional" },
      make("a", { href: descriptionAddress(campaign.name, `${key.includes(".") ? "f" : "s"}-${key}`) }, words), make("span", { class: "quiet" }, effect)))));

/**
 * What can be done with the campaign as a folder.
 * @param {string} name
 */
function keeping(name) {
  const to = make("input", { value: name, required: true, autocomplete: "off" });
  const files = make("input", { type: "file", multiple: true });
  const place = make("div");

  /**
   * @param {string} text shown while the work goes on
   * @param {() => Promise<string>} work it returns the message
   * @param {() => void} then
   */
  const doing = (text, work, then) => attempt(place, async () => {
    place.replaceChildren(working(text));
    say(await work());
    then();
  });
  const go = (/** @type {string} */ where) => () => { location.hash = where; };
  const moved = (/** @type {"copy"|"rename"} */ how, /** @type {string} */ text, /** @type {string} */ said) => () =>
    doing(text, async () => {
      const made = await send("POST", how, { name, to: to.value.trim() });
      return `${said} ${made.name}.`;
    }, () => go(campaignAddress(to.value.trim()))());
  files.addEventListener("change", () => doing("Adding the records", async () => {
    const names = [...files.files ?? []].map((file) => (name ? `${name}/${file.name}` : file.name));
    for (const [place, file] of [...files.files ?? []].entries()) await bring(names[place], file);
    const { added } = await send("POST", "records", { name, files: names });
    return added.length ? `Added ${added.length > 1 ? "runs" : "run"}: ${added.join(", ")}.`
      : "No run was added: the description already contains these records.";
  }, () => dispatchEvent(new HashChangeEvent("hashchange"))));
  return make("details", { class: "keeping" }, make("summary", {}, "Add records, copy, rename or move to trash"),
    make("div", { class: "row" }, labelled("Records to add (each record becomes a run at the detected rate)", files)),
    make("div", { class: "row" }, labelled("Folder name", to),
      make("button", { type: "button", onclick: moved("copy", "Copying the campaign", "Copied to") }, "Copy"),
      make("button", { type: "button", onclick: moved("rename", "Renaming the campaign", "Renamed to") }, "Rename"),
      make("button", {
        type: "button",
        onclick: () => attempt(place, async () => {
          place.replaceChildren(working("Moving the campaign to the trash"));
          const { place: trashed } = await send("POST", "put-away", { name });
          location.hash = "#/";
          say(`Moved ${name} to the trash.`, async () => {
            location.hash = campaignAddress((await send("POST", "restore", { place: trashed })).name);
          });
        }),
      }, "Move to trash")),
    place);
}

/**
 * The page of a campaign.
 * @param {string} name
 */
export async function campaignView(name) {
  const campaign = await get("campaign", { name });
  const result = campaign.results[0];
  const { button, below } = calibration(campaign);
  const good = result && result.state !== "damaged";
  const state = stateMark(campaign.state, campaign.words);
  const steps = campaignTabs(name, "campaign", reachedBy(campaign));
  /** @type {Node[]} */
  const troubles = [
    ...campaign.mistakes.map(warning),
    ...(campaign.missing.length
      ? [warning(`Missing files: ${campaign.missing.join(", ")}`)] : []),
  ];
  /** @type {Node[]} */
  const content = [];
  if (good) {
    const { told, part } = await pagePart("result", [result.name]);
    content.push(...troubles,
      await dashboard({ title: campaign.title, name: result.name, told, part, state, actions: [button], steps, campaign: name }),
      ...below, commandLine(told.command));
  } else {
    content.push(
      make("div", { class: "head" },
        make("div", {}, make("h1", {}, campaign.title, " ", state), name ? make("p", { class: "quiet" }, `Folder ${name}`) : null),
        make("div", { class: "row" }, button)),
      steps, ...troubles, ...campaign.checklist.length ? [checklistPart(campaign)] : [], ...below);
  }
  if (campaign.results.length > 1) {
    content.push(make("section", {}, make("h2", {}, "Results"),
      make("ul", { class: "cards" }, ...campaign.results.map((r) =>
        make("li", { class: "card" }, ...resultLines(r))))));
  }
  const tour = good ? tourOf(name) : null;
  content.push(keeping(name), ...tour ? [tour] : []);
  return { title: campaign.title, content };
}
