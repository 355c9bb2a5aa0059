// @ts-check
// A campaign: calibration and results.

import { campaignAddress, descriptionAddress, resultAddress } from "./addresses.js";
import { uploadFile, get, send } from "./api.js";
import { attempt, commandBlock, commandLine, labelled, make, say, stateMark, warning, working } from "./dom.js";
import { resultLines } from "./folder.js";
import { jobStarter, followRunning } from "./job.js";
import { dashboard, pagePart } from "./result.js";
import { campaignTabs, reachedStep } from "./tabs.js";
import { makeTour } from "./tour.js";

/**
 * Show a new result: here, or on its own page if it is not the campaign's result.
 * @param {string} campaign
 * @param {string} output
 */
async function showResult(campaign, output) {
  const { results } = await get("campaign", { name: campaign });
  if (results[0]?.name === output) dispatchEvent(new HashChangeEvent("hashchange"));
  else location.hash = resultAddress(output);
}

/**
 * The button that calibrates the campaign, and its options.
 * @param {import("./answers.js").CampaignOverview} campaign
 */
function calibrationForm(campaign) {
  const container = make("div");
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
    onsubmit: jobStarter(container, () => send("POST", "jobs", {
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
    commandBlock(campaign.command)));
  followRunning(campaign.jobs, "calibration", container, show);
  return { button, below: [container, form] };
}

/**
 * The checklist of optional entries of the description, with links to their fields.
 * @param {import("./answers.js").CampaignOverview} campaign
 */
const checklistPart = (campaign) => make("section", { class: "panel" }, make("h2", {}, "Checklist"),
  make("p", { class: "quiet" }, "All entries are optional."),
  make("ul", { class: "checklist" }, ...campaign.checklist.map(({ words: label, stated: isStated, effect, key }) =>
    make("li", { class: isStated ? "done" : "optional" },
      make("a", { href: descriptionAddress(campaign.name, `${key.includes(".") ? "f" : "s"}-${key}`) }, label), make("span", { class: "quiet" }, effect)))));

/**
 * Actions on the folder of the campaign.
 * @param {string} name
 */
function folderActions(name) {
  const newName = make("input", { value: name, required: true, autocomplete: "off" });
  const files = make("input", { type: "file", multiple: true });
  const container = make("div");

  /**
   * @param {string} text shown while the work goes on
   * @param {() => Promise<string>} work it returns the message
   * @param {() => void} onDone
   */
  const runAction = (text, work, onDone) => attempt(container, async () => {
    container.replaceChildren(working(text));
    say(await work());
    onDone();
  });
  const goTo = (/** @type {string} */ address) => () => { location.hash = address; };
  const moveFolder = (/** @type {"copy"|"rename"} */ action, /** @type {string} */ text, /** @type {string} */ message) => () =>
    runAction(text, async () => {
      const response = await send("POST", action, { name, to: newName.value.trim() });
      return `${message} ${response.name}.`;
    }, () => goTo(campaignAddress(newName.value.trim()))());
  files.addEventListener("change", () => runAction("Adding the records", async () => {
    const names = [...files.files ?? []].map((file) => (name ? `${name}/${file.name}` : file.name));
    for (const [index, file] of [...files.files ?? []].entries()) await uploadFile(names[index], file);
    const { added: addedRuns } = await send("POST", "records", { name, files: names });
    return addedRuns.length ? `Added ${addedRuns.length > 1 ? "runs" : "run"}: ${addedRuns.join(", ")}.`
      : "No run was added: the description already contains these records.";
  }, () => dispatchEvent(new HashChangeEvent("hashchange"))));
  return make("details", { class: "keeping" }, make("summary", {}, "Add records, copy, rename or move to trash"),
    make("div", { class: "row" }, labelled("Records to add (each record becomes a run at the detected rate)", files)),
    make("div", { class: "row" }, labelled("Folder name", newName),
      make("button", { type: "button", onclick: moveFolder("copy", "Copying the campaign", "Copied to") }, "Copy"),
      make("button", { type: "button", onclick: moveFolder("rename", "Renaming the campaign", "Renamed to") }, "Rename"),
      make("button", {
        type: "button",
        onclick: () => attempt(container, async () => {
          container.replaceChildren(working("Moving the campaign to the trash"));
          const { place: trashName } = await send("POST", "put-away", { name });
          location.hash = "#/";
          say(`Moved ${name} to the trash.`, async () => {
            location.hash = campaignAddress((await send("POST", "restore", { place: trashName })).name);
          });
        }),
      }, "Move to trash")),
    container);
}

/**
 * The page of a campaign.
 * @param {string} name
 */
export async function campaignView(name) {
  const campaign = await get("campaign", { name });
  const result = campaign.results[0];
  const { button, below } = calibrationForm(campaign);
  const hasResult = result && result.state !== "damaged";
  const state = stateMark(campaign.state, campaign.words);
  const steps = campaignTabs(name, "campaign", reachedStep(campaign));
  /** @type {Node[]} */
  const warnings = [
    ...campaign.mistakes.map(warning),
    ...campaign.results.filter(({ state }) => state === "damaged").map(({ words }) => warning(words)),
    ...(campaign.missing.length
      ? [warning(`Missing files: ${campaign.missing.join(", ")}`)] : []),
  ];
  /** @type {Node[]} */
  const content = [];
  if (hasResult) {
    const { told: page, part } = await pagePart("result", [result.name]);
    content.push(...warnings,
      await dashboard({ title: campaign.title, name: result.name, told: page, part, state, actions: [button], steps, campaign: name }),
      ...below, commandLine(page.command));
  } else {
    content.push(
      make("div", { class: "head" },
        make("div", {}, make("h1", {}, campaign.title, " ", state), name ? make("p", { class: "quiet" }, `Folder ${name}`) : null),
        make("div", { class: "row" }, button)),
      steps, ...warnings, ...campaign.checklist.length ? [checklistPart(campaign)] : [], ...below);
  }
  if (campaign.results.length > 1) {
    content.push(make("section", {}, make("h2", {}, "Results"),
      make("ul", { class: "cards" }, ...campaign.results.map((otherResult) =>
        make("li", { class: "card" }, ...resultLines(otherResult))))));
  }
  const tour = hasResult ? makeTour(name) : null;
  content.push(folderActions(name), ...tour ? [tour] : []);
  return { title: campaign.title, content };
}
